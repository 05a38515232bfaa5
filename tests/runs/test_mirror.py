"""The mirror uploads a run despite outages, refuses folders of other runs, and stops after a later start."""

import errno
import json
import logging
import os
import shutil
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO
from unittest.mock import Mock

import pytest

from accidents import without_permission
from gcs import Failure, Gcs
from mirrors import REMOTE, content, names, remote_checkpoints, write
from vjepa2_ac import storage
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.errors import RefusedError, UnreachableError
from vjepa2_ac.runs.checkpoint import RunState, checkpoint_name, find_damage
from vjepa2_ac.runs.folder import ENVIRONMENT, UPLOAD_LINKS, open_run_folder
from vjepa2_ac.runs.mirror import UPLOADING, Mirror, RemoteCheckpoints
from vjepa2_ac.storage import retries, transfer

UPLOAD = "POST /upload/"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yaml").write_text("seed: 0\n")
    (folder / "metrics.jsonl").write_text('{"kind": "train", "step": 1}\n')
    return folder


def mirror_of(run: Path, remote: str = REMOTE, run_id: str = "mine", **checkpoint: float) -> Mirror:
    settings = {"keep": 3, "remote": remote, "remote_every_minutes": 0.0, **checkpoint}
    values = {"run_dir": str(run), "data": {"path": "d"}, "model": {"base": "b"}, "checkpoint": settings}
    return Mirror(remote, parse_config(values, where=""), run_id)


def upload_and_wait(mirror: Mirror) -> None:
    """Start an upload pass if one is due, and wait for it."""
    mirror.upload_if_due()
    if mirror._thread is not None:
        mirror._thread.join()


def upload_all(run: Path, **arguments: object) -> Mirror:
    mirror = mirror_of(run, **arguments)
    mirror.finish(lambda: False)
    return mirror


@pytest.fixture(params=["gs", "folder", "file", "memory"])
def remote(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "gs":
        request.getfixturevalue("bucket")
    return {
        "gs": REMOTE, "folder": str(tmp_path / "disk/run"), "file": storage.canonical_path(f"file://{tmp_path}/disk/run"),
        "memory": f"memory://{tmp_path.name}/run",
    }[request.param]  # fmt: skip


def test_upload_starts_with_the_state_and_ends_with_the_manifest(
    run: Path, remote: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    write(run, 10)
    order, upload = [], storage.upload
    monkeypatch.setattr(
        storage, "upload", lambda source, target: [order.append(target.rsplit("/", 1)[1]), upload(source, target)]
    )
    upload_all(run, remote=remote)
    assert order == [
        "config.yaml", "metrics.jsonl", UPLOADING, "state.json", "weights.bin", "optimizer.pt", "manifest.json",
    ]  # fmt: skip
    assert content(remote) == content(run)
    assert not (run / UPLOAD_LINKS).exists()
    assert not caplog.records


@pytest.mark.parametrize("num_uploaded", [0, 2, 4, 7])
def test_files_uploaded_before_an_interruption_are_not_uploaded_again(
    bucket: Gcs, run: Path, num_uploaded: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(run, 10)
    monkeypatch.setattr(retries, "DEFAULT", retries.RetryPolicy(attempts=1))
    original, uploads = Gcs._failure_of, []

    def fail_after(gcs: Gcs, target: str) -> Failure | None:
        uploads.extend([target] if target.startswith(UPLOAD) else [])
        return 503 if len(uploads) > num_uploaded and target.startswith(UPLOAD) else original(gcs, target)

    monkeypatch.setattr(Gcs, "_failure_of", fail_after)
    upload_all(run)
    total = 2 + 1 + 3 + 1  # small files, the manifest under another name, the files, the manifest
    assert remote_checkpoints() == (names(10) if num_uploaded == total else [])
    monkeypatch.setattr(Gcs, "_failure_of", original)
    bucket.forget()
    upload_all(run)
    assert content(f"{REMOTE}/checkpoints/{checkpoint_name(10)}") == content(run / "checkpoints" / checkpoint_name(10))
    num_small = 2  # a new process uploads the small files again
    assert len(bucket.uploads()) == num_small + min(total - num_small, total - max(num_uploaded, num_small))


@pytest.mark.usefixtures("bucket")
def test_files_of_a_different_checkpoint_with_the_same_name_are_replaced(run: Path) -> None:
    first = write(run, 10)
    upload_all(run)
    shutil.rmtree(first)
    write(run, 10, words="OF STEP")
    upload_all(run)
    assert content(f"{REMOTE}/checkpoints/{checkpoint_name(10)}") == content(run / "checkpoints" / checkpoint_name(10))


def test_remote_folder_keeps_the_same_checkpoints_as_the_run_folder(bucket: Gcs, run: Path) -> None:
    mirror, state = mirror_of(run), RunState(0)
    for step, error in [(10, 0.9), (20, 0.5), (30, 0.8), (40, 0.7), (50, 0.6), (60, 0.6)]:
        state = replace(state, step=step).with_validation(error)
        write(run, step, state)
        upload_and_wait(mirror)
    assert (
        remote_checkpoints() == names(20, 40, 50, 60) == sorted(path.name for path in (run / "checkpoints").iterdir())
    )
    assert content(f"{REMOTE}/checkpoints") == content(run / "checkpoints")
    deletions = [r.target for r in bucket.requests if r.target.startswith("DELETE") and checkpoint_name(10) in r.target]
    assert deletions[1].endswith("manifest.json"), "the first deletion is that of the manifest's temporary name"
    assert not [name for name in bucket.names("bucket") if checkpoint_name(10) in name or UPLOADING in name]


def test_incomplete_remote_checkpoints_are_removed_and_later_ones_kept(bucket: Gcs, run: Path) -> None:
    for step in (10, 90):
        bucket.put(f"bucket/run/checkpoints/{checkpoint_name(step)}/state.json", b'{"run_id": "mine"}')
    bucket.put(f"bucket/run/checkpoints/{checkpoint_name(5)}/optimizer.pt", b"?")
    bucket.put("bucket/run/checkpoints/notes.txt", b"mine")
    write(run, 20)
    upload_all(run)
    assert sorted(RemoteCheckpoints(REMOTE).list_files()) == names(20, 90)
    assert "run/checkpoints/notes.txt" in bucket.names("bucket")


class Gate:
    """Blocks uploads until `opened` is set, and sets `waiting` when an upload is blocked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, match: str = "") -> None:
        self.waiting, self.opened = threading.Event(), threading.Event()
        self.num_uploads = self.max_uploads = 0
        upload = storage.upload

        def gated(source: Path, target: str) -> None:
            self.num_uploads += 1
            self.max_uploads = max(self.max_uploads, self.num_uploads)
            if match in target:
                self.waiting.set()
                assert self.opened.wait(120)
            upload(source, target)
            self.num_uploads -= 1

        monkeypatch.setattr(storage, "upload", gated)


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Gate]:
    return lambda match: Gate(monkeypatch, match)


@pytest.mark.usefixtures("bucket")
def test_training_continues_during_an_upload_and_uploads_do_not_overlap(run: Path, gate: Callable[[str], Gate]) -> None:
    closed_gate = gate("optimizer.pt")
    mirror = mirror_of(run)
    write(run, 10, keep=1)
    mirror.upload_if_due()
    assert closed_gate.waiting.wait(120)
    write(run, 20, keep=1)  # removes the checkpoint that is being uploaded
    assert not (run / "checkpoints" / checkpoint_name(10)).exists()
    for _ in range(5):
        mirror.upload_if_due()
    assert mirror.is_uploading
    closed_gate.opened.set()
    mirror._thread.join()
    assert remote_checkpoints() == names(10), "hard links keep the files until the upload is complete"
    assert RemoteCheckpoints(REMOTE).download(checkpoint_name(10), run.parent / "copy") is None
    upload_and_wait(mirror)
    assert remote_checkpoints() == names(10, 20)
    assert closed_gate.max_uploads == 1


@pytest.mark.usefixtures("bucket")
def test_upload_that_exceeds_its_time_is_reported_and_abandoned(
    run: Path, gate: Callable[[str], Gate], caplog: pytest.LogCaptureFixture
) -> None:
    closed_gate = gate("weights")
    write(run, 10)
    mirror = mirror_of(run, remote_wait_seconds=0.2)
    mirror.finish(lambda: closed_gate.waiting.is_set())
    assert f"Later checkpoints in {run / 'checkpoints'} are only on this machine, because the time" in caplog.text
    assert mirror.is_uploading
    closed_gate.opened.set()
    mirror._thread.join()
    assert remote_checkpoints() == [], "the upload must stop before the next file"


@pytest.mark.usefixtures("bucket")
def test_finish_cancels_an_older_upload_and_uploads_the_newest(run: Path, gate: Callable[[str], Gate]) -> None:
    closed_gate = gate("weights")
    write(run, 10)
    mirror = mirror_of(run, remote_every_minutes=30.0)
    mirror.upload_if_due()
    assert closed_gate.waiting.wait(120)
    write(run, 20)
    threading.Timer(0.05, closed_gate.opened.set).start()
    mirror.finish(lambda: False)
    assert remote_checkpoints() == names(20)
    assert sorted(RemoteCheckpoints(REMOTE).list_files()) == names(20)


@pytest.mark.usefixtures("bucket")
def test_remote_folder_of_another_run_is_never_written(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(run, 10)
    upload_all(run)
    before = content("gs://bucket")
    (run / "metrics.jsonl").write_text("rows of another run")
    other = write(run, 20)
    mirror = mirror_of(run, run_id="other")
    caplog.clear()
    upload_and_wait(mirror)
    mirror.upload_if_due()
    mirror.finish(lambda: False)
    assert content("gs://bucket") == before
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert f"contains a checkpoint of another run, {checkpoint_name(10)}" in caplog.text
    assert find_damage(other) is None


@pytest.fixture
def _no_links(monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system without hard links."""
    monkeypatch.setattr(os, "link", Mock(side_effect=PermissionError(1, "Operation not permitted")))


@pytest.mark.usefixtures("bucket", "_no_links")
def test_without_hard_links_a_checkpoint_is_copied(run: Path) -> None:
    write(run, 10)
    upload_all(run)
    assert content(f"{REMOTE}/checkpoints/{checkpoint_name(10)}") == content(run / "checkpoints" / checkpoint_name(10))


@pytest.mark.usefixtures("bucket", "_no_links")
def test_unreadable_newest_checkpoint_is_reported_and_no_older_one_uploaded(
    run: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(run, 10)
    newest, mirror = write(run, 20), mirror_of(run)
    with without_permission(newest / "optimizer.pt"):
        upload_and_wait(mirror)
    assert remote_checkpoints() == []
    assert "Permission denied" in caplog.text
    upload_and_wait(mirror)
    assert remote_checkpoints() == names(20)


@pytest.mark.parametrize("name", ["/etc/x", "../x", "a/../../x", ""])
def test_remote_manifest_with_outside_paths_is_damage(bucket: Gcs, tmp_path: Path, name: str) -> None:
    manifest = json.dumps({"files": {name: "0"}}).encode()
    bucket.put(f"bucket/run/checkpoints/{checkpoint_name(10)}/manifest.json", manifest)
    problem = RemoteCheckpoints(REMOTE).download(checkpoint_name(10), tmp_path / "copy")
    assert problem is not None
    assert "which is outside the folder" in problem


# A remote folder that is full or unreachable during a run causes one warning, and is updated when it works again.

CHECKPOINT_BYTES = 40_000  # approximate size of a checkpoint


def save_and_upload(run: Path, mirror: Mirror, *steps: int, **options: Any) -> None:
    for step in steps:
        write(run, step, **options)
        upload_and_wait(mirror)


@pytest.mark.parametrize(
    ("status", "match"),
    [(403, "POST /upload/"), (403, "DELETE"), (401, ""), (507, "POST /upl")],
)
def test_outage_of_a_bucket_causes_one_warning(
    bucket: Gcs, run: Path, status: int, match: str, caplog: pytest.LogCaptureFixture
) -> None:
    mirror = mirror_of(run)
    save_and_upload(run, mirror, 10)
    bucket.fail_next(status, times=10_000, match=match)
    save_and_upload(run, mirror, 20, 30)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert str(status) in caplog.text
    assert "Training continues; next attempt in 0 minutes" in caplog.text
    bucket.forget()
    save_and_upload(run, mirror, 40)
    assert remote_checkpoints() == (names(20, 30, 40) if match == "DELETE" else names(10, 40))
    mirror.finish(lambda: False)
    assert len(caplog.records) == 1


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_upload_to_a_full_disk_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    monkeypatch.setattr(transfer.tempfile, "TemporaryFile", Mock(side_effect=OSError(code, "No room")))
    with pytest.raises(UnreachableError) as caught:
        storage.check_writable(str(tmp_path))
    assert not isinstance(caught.value, RefusedError), "training must start, with a warning"


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_incomplete_checkpoints_on_a_full_disk_are_removed(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, code: int
) -> None:
    remote, capacity = tmp_path / "disk", int(4.2 * CHECKPOINT_BYTES)  # three kept checkpoints and a new one

    def copy_within_capacity(source: BinaryIO, target: BinaryIO) -> None:
        used = sum(path.stat().st_size for path in remote.rglob("*") if path.is_file())
        data = source.read()
        if used + len(data) > capacity:
            raise OSError(code, "No room")
        target.write(data)

    monkeypatch.setattr(transfer, "shutil", SimpleNamespace(copyfileobj=copy_within_capacity, rmtree=shutil.rmtree))
    mirror = mirror_of(run, str(remote))
    save_and_upload(run, mirror, 10, 20, 30, 40)
    capacity -= CHECKPOINT_BYTES // 2  # other programs use it
    save_and_upload(run, mirror, 50, 60, 70)
    assert remote_checkpoints(str(remote)) == names(20, 30, 40)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "No room" in caplog.text
    capacity += CHECKPOINT_BYTES // 2
    save_and_upload(run, mirror, 80)
    assert remote_checkpoints(str(remote)) == names(30, 40, 80)
    assert len(list((remote / "checkpoints").iterdir())) == 3
    assert len(caplog.records) == 1


# Two machines with the same remote folder: only the later start continues to upload


@dataclass
class Machine:
    """A machine that trains and uploads each checkpoint."""

    folder: Path
    remote: str
    run_id: str

    def __post_init__(self) -> None:
        self.mirror = mirror_of(self.folder, self.remote, self.run_id)

    def save_and_upload(self, *steps: int) -> None:
        state = RunState(0, run_id=self.run_id)
        save_and_upload(self.folder, self.mirror, *steps, state=state, words=self.folder.name)


@pytest.fixture
def disk(tmp_path: Path) -> str:
    return str(tmp_path / "disk")


@pytest.fixture
def machine(tmp_path: Path, disk: str, monkeypatch: pytest.MonkeyPatch, make_config):
    def start(name: str, run_id: str = "mine") -> Machine:
        monkeypatch.setattr("platform.node", lambda: name)
        open_run_folder(make_config(run_dir=str(tmp_path / name)), run_id)
        return Machine(tmp_path / name, disk, run_id)

    return start


def test_later_start_keeps_the_remote_folder_and_the_earlier_one_warns_once(
    machine, disk: str, caplog: pytest.LogCaptureFixture
) -> None:
    first = machine("one")
    first.save_and_upload(10, 20)
    second = machine("two")
    second.save_and_upload(30)
    before = content(disk)
    first.save_and_upload(30, 40)
    first.mirror.finish(lambda: False)
    assert content(disk) == before
    (warning,) = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert (
        f"{disk} is used by a later start of this run, process {os.getpid()} on two, since 20" in warning.getMessage()
    )
    second.save_and_upload(40)
    second.mirror.finish(lambda: False)
    assert remote_checkpoints(disk)[-1] == checkpoint_name(40)
    assert storage.read_bytes(f"{disk}/checkpoints/{checkpoint_name(40)}/optimizer.pt").startswith(b"two")
    assert len(caplog.records) == 1


def test_only_one_of_two_simultaneous_starts_keeps_the_remote_folder(
    machine, disk: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both starts find an empty remote folder; the runs have different ids."""
    first, second = machine("one", "this"), machine("two", "that")
    with monkeypatch.context() as patch:
        patch.setattr(RemoteCheckpoints, "list_files", lambda _: {})
        first.save_and_upload(10)
        second.save_and_upload(10)
    first.save_and_upload(20)
    second.save_and_upload(20)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "continues without it" in caplog.text or "of another run" in caplog.text
    state = f"{disk}/checkpoints/{checkpoint_name(20)}/state.json"
    assert json.loads(storage.read_bytes(state))["run_id"] == "that"


def test_removed_list_of_starts_does_not_stop_uploads(machine, disk: str, caplog) -> None:
    first = machine("one")
    first.save_and_upload(10)
    (Path(disk) / ENVIRONMENT).unlink()
    first.save_and_upload(20)
    assert not caplog.records
    assert (Path(disk) / ENVIRONMENT).read_bytes() == (first.folder / ENVIRONMENT).read_bytes()
    assert remote_checkpoints(disk) == names(10, 20)
