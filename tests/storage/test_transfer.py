"""Uploads: complete despite temporary failures; permanent failures are reported in time."""

import os
from pathlib import Path

import pytest

from gcs import Failure, Gcs
from vjepa2_ac import storage
from vjepa2_ac.errors import RefusedError, UnreachableError
from vjepa2_ac.storage import remote, retries

SMALL, LARGE = 3000, 6 << 20  # gcsfs sends more than 5 MB in parts
URL = "gs://bucket/run/file"

pytestmark = pytest.mark.filterwarnings("ignore:Sending a large body:ResourceWarning")  # aiohttp warns about gcsfs


@pytest.fixture
def bucket(gcs: Gcs) -> Gcs:
    gcs.put("bucket/before", b"1")
    gcs.forget()
    return gcs


def source_of(folder: Path, size: int) -> Path:
    path = folder / "source"
    # gcsfs ends its parts with "\n", and the emulator removes a "\r" at the end of the data
    path.write_bytes(os.urandom(max(size - 1, 0)) + b"\0" * (size > 0))
    return path


@pytest.mark.usefixtures("bucket")
@pytest.mark.parametrize("size", [0, SMALL, LARGE])
def test_uploaded_file_is_read_back(tmp_path: Path, size: int) -> None:
    source = source_of(tmp_path, size)
    storage.upload(source, URL)
    assert storage.read_bytes(URL) == source.read_bytes()
    assert storage.file_sizes("gs://bucket/run") == {"file": size}
    storage.download(URL, tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == source.read_bytes()


@pytest.mark.parametrize("size", [SMALL, LARGE])
@pytest.mark.parametrize("failure", [408, 429, 500, 503, "reset", "cut"])
def test_upload_survives_temporary_failures(bucket: Gcs, tmp_path: Path, size: int, failure: Failure) -> None:
    source = source_of(tmp_path, size)
    bucket.fail_next(failure, times=2, match="POST /upload/")
    storage.upload(source, URL)
    assert bucket.faults_left == 0
    assert storage.read_bytes(URL) == source.read_bytes()


@pytest.mark.usefixtures("bucket")
def test_failure_between_parts_leaves_nothing_and_restarts_the_upload(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote, "_PART_BYTES", 2 << 20)
    source = source_of(tmp_path, LARGE)
    requests = []
    original = Gcs._failure_of

    def fail_second_part(gcs: Gcs, target: str) -> Failure | None:
        if "upload_id" in target and target.startswith("POST"):
            requests.append(target)
            if len(requests) == 2:
                return 503
        return original(gcs, target)

    monkeypatch.setattr(Gcs, "_failure_of", fail_second_part)
    storage.upload(source, URL)
    assert storage.read_bytes(URL) == source.read_bytes()
    assert len(requests) == 2 + 3, "two in the first attempt, three in the second"


def test_stalled_upload_times_out_and_is_retried(bucket: Gcs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Further attempts, because a busy machine may exceed the time-out.
    monkeypatch.setattr(retries, "DEFAULT", retries.RetryPolicy(attempts=100, first_wait_s=0.0, timeout_s=0.3))
    source = source_of(tmp_path, SMALL)
    bucket.fail_next("hang", match="POST /upload/")
    storage.upload(source, URL)
    monkeypatch.setattr(retries, "DEFAULT", retries.RetryPolicy(attempts=2, first_wait_s=0.0, timeout_s=0.3))
    bucket.fail_next("hang", times=100, match="POST /upload/")
    with pytest.raises(UnreachableError, match="2 attempts in") as raised:
        storage.upload(source, URL)
    assert not isinstance(raised.value, RefusedError)


@pytest.mark.parametrize(
    ("failure", "message"),
    [(403, r"no permission .*You are not logged in\. Log in with `gcloud"), (412, "cannot be written")],
)
def test_refused_upload_is_not_retried(bucket: Gcs, tmp_path: Path, failure: int, message: str) -> None:
    bucket.fail_next(failure, times=9)
    with pytest.raises(RefusedError, match=message):
        storage.upload(source_of(tmp_path, SMALL), URL)
    assert len(bucket.requests) == 1


@pytest.mark.usefixtures("bucket")
def test_missing_bucket_raises_with_its_name(tmp_path: Path) -> None:
    for action in (
        lambda: storage.upload(source_of(tmp_path, SMALL), "gs://other/run/file"),
        lambda: storage.file_sizes("gs://other/run"),
        lambda: storage.check_writable("gs://other/run"),
    ):
        with pytest.raises(RefusedError, match="bucket other does not exist"):
            action()


@pytest.fixture(params=["gs", "memory", "folder"])
def target(request: pytest.FixtureRequest, bucket: Gcs, tmp_path: Path) -> str:
    """Return a target folder in an object store, in an fsspec file system with folders, or on this machine."""
    assert bucket.names("bucket") == ["before"]
    return {"gs": "gs://bucket/run", "memory": f"memory://{tmp_path.name}/run", "folder": str(tmp_path / "at/run")}[
        request.param
    ]


def test_each_kind_of_folder_is_written_listed_and_removed(target: str, tmp_path: Path) -> None:
    source = source_of(tmp_path, SMALL)
    assert storage.file_sizes(target) == {}
    for name in ("a", "inner/b", "inner/deep/c"):
        storage.upload(source, storage.join(target, name))
    assert storage.file_sizes(target) == dict.fromkeys(("a", "inner/b", "inner/deep/c"), SMALL)
    source.write_bytes(b"other")
    storage.upload(source, storage.join(target, "a"))
    assert storage.read_bytes(storage.join(target, "a")) == b"other"
    storage.remove(storage.join(target, "a"))
    storage.remove(storage.join(target, "a"))
    storage.remove_folder(storage.join(target, "inner"), first="deep/c")
    storage.remove_folder(storage.join(target, "inner"), first="deep/c")
    assert storage.file_sizes(target) == {}


def test_check_writable_leaves_no_file(target: str, bucket: Gcs, tmp_path: Path) -> None:
    storage.check_writable(target)
    assert storage.file_sizes(target) == {}
    assert not (tmp_path / "at").exists()
    assert bucket.names("bucket") == ["before"]


def test_unwritable_local_folder_raises(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for action in (
        lambda: storage.upload(source_of(tmp_path, SMALL), str(tmp_path / "file/inner/a")),
        lambda: storage.check_writable("/proc/none"),
    ):
        with pytest.raises(RefusedError, match="cannot be written"):
            action()


def test_canonical_path_is_unique(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert (
        storage.canonical_path("runs/one/")
        == storage.canonical_path(f"file://{tmp_path}/runs/one")
        == str(tmp_path / "runs/one")
    )
    assert storage.canonical_path("gs://bucket/run/") == "gs://bucket/run"


@pytest.mark.usefixtures("bucket")
def test_readers_request_read_only_access(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "_filesystems", {})
    storage.file_sizes("gs://bucket/run")
    assert [system.credentials.access for system in remote._filesystems.values()] == ["read_only"]
    storage.upload(source_of(tmp_path, SMALL), URL)
    assert [system.credentials.access for system in remote._filesystems.values()] == ["read_only", "read_write"]


def test_file_removed_during_listing_is_omitted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("kept", "temporary"):
        (tmp_path / name).write_bytes(b"1")
    is_file = Path.is_file

    def remove_temporary_file(path: Path) -> bool:
        existed = is_file(path)
        if path.name == "temporary":
            path.unlink()
        return existed

    monkeypatch.setattr(Path, "is_file", remove_temporary_file)
    assert storage.file_sizes(str(tmp_path)) == {"kept": 1}
