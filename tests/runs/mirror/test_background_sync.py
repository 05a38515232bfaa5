"""Background upload: the mirror follows the run over any network, and belongs to this run only."""

import json
import logging
import shutil
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from gcs import Failure, Gcs
from vjepa2_ac import storage
from vjepa2_ac.config import CheckpointConfig
from vjepa2_ac.runs.checkpoint import RunState, checkpoint_name, find_damage, read_state, write_checkpoint
from vjepa2_ac.runs.mirror import upload
from vjepa2_ac.runs.mirror.background_sync import Mirror
from vjepa2_ac.runs.mirror.remote_checkpoints import SENDING, RemoteCheckpoints, complete
from vjepa2_ac.runs.mirror.upload import HELD, RemoteUpdate
from vjepa2_ac.storage import retries

PLACE = "gs://bucket/run"
FILES = {"adapter/weights.bin", "optimizer.pt", "state.json"}
UPLOAD = "POST /upload/"


@pytest.fixture
def bucket(gcs: Gcs) -> Gcs:
    gcs.put("bucket/other", b"1")
    gcs.forget()
    return gcs


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yaml").write_text("seed: 0\n")
    (folder / "metrics.jsonl").write_text('{"kind": "train", "step": 1}\n')
    return folder


def write(run: Path, step: int, state: RunState | None = None, keep: int = 3) -> Path:
    def files(folder: Path) -> None:
        (folder / "adapter").mkdir()
        (folder / "adapter/weights.bin").write_bytes(f"weights {step} ".encode() * 1000)
        (folder / "optimizer.pt").write_bytes(f"moments {step} ".encode() * 2000)

    return write_checkpoint(
        run / "checkpoints", replace(state or RunState(step), step=step, run_id="mine"), files, keep=keep
    )


def mirror_of(run: Path, place: str = PLACE, run_id: str = "mine", **arguments: object) -> Mirror:
    minutes, seconds = arguments.pop("minutes", 0.0), arguments.pop("wait_seconds", 30.0)
    config = CheckpointConfig(keep=3, remote=place, remote_every_minutes=minutes, remote_wait_seconds=seconds)
    update = RemoteUpdate(RemoteCheckpoints(place), run, run_id, config.keep, arguments.pop("damaged", ()))
    return Mirror(update, config, **arguments)


def send(run: Path, **arguments: object) -> Mirror:
    mirror = mirror_of(run, **arguments)
    mirror.finish(lambda: False)
    return mirror


def there(place: str = PLACE) -> list[str]:
    return sorted(complete(RemoteCheckpoints(place).listing()))


def names(*steps: int) -> list[str]:
    return [checkpoint_name(step) for step in steps]


def assert_same_files(run: Path, name: str, place: str = PLACE) -> None:
    folder = run / "checkpoints" / name
    local = {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    remote = storage.join(place, f"checkpoints/{name}")
    assert {file: storage.read_bytes(storage.join(remote, file)) for file in storage.file_sizes(remote)} == local


@pytest.fixture(params=["gs", "folder", "file", "memory"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "gs":
        request.getfixturevalue("bucket")
    return {
        "gs": PLACE, "folder": str(tmp_path / "disk/run"), "file": storage.absolute(f"file://{tmp_path}/disk/run"),
        "memory": f"memory://{tmp_path.name}/run",
    }[request.param]  # fmt: skip


def test_a_run_is_copied_to_any_kind_of_place(run: Path, place: str, caplog: pytest.LogCaptureFixture) -> None:
    write(run, 10)
    send(run, place=place)
    assert there(place) == names(10)
    assert_same_files(run, checkpoint_name(10), place)
    for name in ("config.yaml", "metrics.jsonl"):
        assert storage.read_bytes(storage.join(place, name)) == (run / name).read_bytes()
    assert not (run / HELD).exists()
    assert not caplog.records


def test_whose_it_is_comes_first_and_the_manifest_last(run: Path, place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    write(run, 10)
    order = []
    for module in ("upload", "remote_checkpoints"):
        monkeypatch.setattr(
            f"vjepa2_ac.runs.mirror.{module}.upload",
            lambda source, target: [order.append(target.rsplit("/", 1)[1]), storage.upload(source, target)],
        )
    send(run, place=place)
    assert order == [
        "config.yaml", "metrics.jsonl", SENDING, "state.json", "weights.bin", "optimizer.pt", "manifest.json",
    ]  # fmt: skip
    assert RemoteCheckpoints(place).listing()[checkpoint_name(10)].keys() == {*FILES, "manifest.json"}


@pytest.mark.parametrize("failure", [429, 503, "reset", "cut"])
def test_it_survives_what_passes(bucket: Gcs, run: Path, failure: Failure, caplog: pytest.LogCaptureFixture) -> None:
    write(run, 10)
    bucket.fail_next(failure, times=4)
    bucket.fail_next(failure, times=4, match=UPLOAD)
    bucket.fail_next(failure, match="DELETE")
    send(run)
    assert bucket.faults_left == 0
    assert_same_files(run, checkpoint_name(10))
    assert not caplog.records


@pytest.mark.parametrize("sent_before", [0, 2, 4, 7])
def test_what_was_sent_before_a_break_is_not_sent_again(
    bucket: Gcs, run: Path, sent_before: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(run, 10)
    monkeypatch.setattr(retries, "DEFAULT", retries.RetryPolicy(attempts=1))
    answer, uploads = Gcs._failure_of, []

    def fail_after(gcs: Gcs, target: str) -> Failure | None:
        uploads.extend([target] if target.startswith(UPLOAD) else [])
        return 503 if len(uploads) > sent_before and target.startswith(UPLOAD) else answer(gcs, target)

    monkeypatch.setattr(Gcs, "_failure_of", fail_after)
    send(run)
    total = 2 + 1 + 3 + 1  # small files, the manifest under another name, the files, the manifest
    assert there() == (names(10) if sent_before == total else [])
    monkeypatch.setattr(Gcs, "_failure_of", answer)
    bucket.forget()
    send(run)
    assert_same_files(run, checkpoint_name(10))
    small = 2  # a new process does not know of them
    assert len(bucket.uploads()) == small + min(total - small, total - max(sent_before, small))


@pytest.mark.usefixtures("bucket")
def test_files_of_another_checkpoint_by_the_same_name_are_not_taken_for_its_own(run: Path) -> None:
    first = write(run, 10)
    send(run)
    shutil.rmtree(first)
    write_other(run)
    send(run)
    assert_same_files(run, checkpoint_name(10))


def write_other(run: Path) -> None:
    """Write a checkpoint of step 10 with other bytes, and as many."""

    def files(folder: Path) -> None:
        (folder / "adapter").mkdir()
        (folder / "adapter/weights.bin").write_bytes(b"WEIGHTS 10 " * 1000)
        (folder / "optimizer.pt").write_bytes(b"MOMENTS 10 " * 2000)

    write_checkpoint(run / "checkpoints", RunState(10, run_id="mine"), files, keep=3)


@pytest.mark.usefixtures("bucket")
def test_small_files_are_sent_when_they_have_changed(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = []
    monkeypatch.setattr(upload, "upload", lambda _, target: sent.append(target.rsplit("/", 1)[1]))
    mirror = mirror_of(run)
    for step in (10, 20):
        write(run, step)
        with (run / "metrics.jsonl").open("a") as metrics:
            metrics.write("{}\n")
        mirror.tick()
        mirror._thread.join()
    assert sent == ["config.yaml", "metrics.jsonl", "metrics.jsonl"]


def test_the_same_are_kept_there_as_here(bucket: Gcs, run: Path) -> None:
    mirror, state = mirror_of(run), RunState(0)
    for step, error in [(10, 0.9), (20, 0.5), (30, 0.8), (40, 0.7), (50, 0.6), (60, 0.6)]:
        state = replace(state, step=step).measured(error)
        write(run, step, state)
        mirror.tick()
        mirror._thread.join()
    assert there() == names(20, 40, 50, 60) == sorted(path.name for path in (run / "checkpoints").iterdir())
    for name in there():
        assert_same_files(run, name)
    gone = [r.target for r in bucket.requests if r.target.startswith("DELETE") and checkpoint_name(10) in r.target]
    assert gone[1].endswith("manifest.json"), gone  # the first was the claim
    assert not [name for name in bucket.names("bucket") if checkpoint_name(10) in name or SENDING in name]


def test_what_was_left_by_halves_goes_and_what_is_further_on_stays(bucket: Gcs, run: Path) -> None:
    for step in (10, 90):
        bucket.put(f"bucket/run/checkpoints/{checkpoint_name(step)}/state.json", b'{"run_id": "mine"}')
    bucket.put(f"bucket/run/checkpoints/{checkpoint_name(5)}/optimizer.pt", b"?")
    bucket.put("bucket/run/checkpoints/notes.txt", b"mine")
    write(run, 20)
    send(run)
    assert sorted(RemoteCheckpoints(PLACE).listing()) == names(20, 90)
    assert "run/checkpoints/notes.txt" in bucket.names("bucket")


class Gate:
    """Holds uploads until it is opened, and says when one waits."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, match: str = "") -> None:
        self.waiting, self.opened = threading.Event(), threading.Event()
        self.sending = self.most = 0
        upload = storage.upload

        def gated(source: Path, target: str) -> None:
            self.sending += 1
            self.most = max(self.most, self.sending)
            if match in target:
                self.waiting.set()
                assert self.opened.wait(120)
            upload(source, target)
            self.sending -= 1

        for module in ("upload", "remote_checkpoints"):
            monkeypatch.setattr(f"vjepa2_ac.runs.mirror.{module}.upload", gated)


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Gate]:
    return lambda match: Gate(monkeypatch, match)


@pytest.mark.usefixtures("bucket")
def test_training_goes_on_while_something_is_sent_and_nothing_is_sent_twice_at_once(
    run: Path, gate: Callable[[str], Gate]
) -> None:
    held = gate("optimizer.pt")
    mirror = mirror_of(run)
    write(run, 10, keep=1)
    mirror.tick()
    assert held.waiting.wait(120)
    write(run, 20, keep=1)  # removes what is being sent
    assert not (run / "checkpoints" / checkpoint_name(10)).exists()
    for _ in range(5):
        mirror.tick()
    assert mirror.is_sending
    held.opened.set()
    mirror._thread.join()
    assert there() == names(10), "held by links, it came whole"
    assert RemoteCheckpoints(PLACE).fetch(checkpoint_name(10), run.parent / "copy") is None
    mirror.tick()
    mirror._thread.join()
    assert there() == names(10, 20)
    assert held.most == 1


@pytest.mark.usefixtures("bucket")
def test_a_copy_that_does_not_end_in_time_is_named_and_left(
    run: Path, gate: Callable[[str], Gate], caplog: pytest.LogCaptureFixture
) -> None:
    held = gate("weights")
    write(run, 10)
    mirror = mirror_of(run, wait_seconds=0.2)
    mirror.finish(lambda: held.waiting.is_set())
    assert f"what {run / 'checkpoints'} has after that is on this machine only: there was no more time" in caplog.text
    assert mirror.is_sending
    held.opened.set()
    mirror._thread.join()
    assert there() == [], "it has stopped before the next file"


@pytest.mark.usefixtures("bucket")
def test_in_the_end_the_newest_is_sent_instead_of_the_one_that_was_on_its_way(
    run: Path, gate: Callable[[str], Gate]
) -> None:
    held = gate("weights")
    write(run, 10)
    mirror = mirror_of(run, minutes=30.0)
    mirror.tick()
    assert held.waiting.wait(120)
    write(run, 20)
    threading.Timer(0.05, held.opened.set).start()
    mirror.finish(lambda: False)
    assert there() == names(20)
    assert sorted(RemoteCheckpoints(PLACE).listing()) == names(20)


def test_a_place_of_another_run_is_never_written(bucket: Gcs, run: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(run, 10)
    send(run)
    before = {name: storage.read_bytes(f"gs://bucket/{name}") for name in bucket.names("bucket")}
    (run / "metrics.jsonl").write_text("others'")
    other = write(run, 20)
    mirror = mirror_of(run, run_id="other", damaged=names(10))
    caplog.clear()
    mirror.tick()
    mirror._thread.join()
    mirror.tick()
    mirror.finish(lambda: False)
    assert {name: storage.read_bytes(f"gs://bucket/{name}") for name in bucket.names("bucket")} == before
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert f"holds a checkpoint of another run, {checkpoint_name(10)}" in caplog.text
    assert find_damage(other) is None


def test_damaged_checkpoints_there_are_replaced_or_removed(bucket: Gcs, run: Path) -> None:
    write(run, 10)
    send(run)
    victim = f"run/checkpoints/{checkpoint_name(10)}/optimizer.pt"
    flipped = bytearray(storage.read_bytes(f"gs://bucket/{victim}"))
    flipped[7] ^= 1
    bucket.put(f"bucket/{victim}", bytes(flipped))
    further = f"bucket/run/checkpoints/{checkpoint_name(90)}"
    bucket.put(f"{further}/state.json", b'{"run_id": "mine"}')
    bucket.put(f"{further}/manifest.json", b"?")
    send(run, damaged=names(10, 90))
    assert_same_files(run, checkpoint_name(10))
    assert there() == names(10), "nobody is to try the other one again"


@pytest.mark.usefixtures("bucket")
def test_without_hard_links_a_checkpoint_is_copied(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(upload.os, "link", no_links)
    write(run, 10)
    send(run)
    assert_same_files(run, checkpoint_name(10))


def test_a_checkpoint_that_is_fetched_is_the_one_that_was_sent(run: Path, place: str, tmp_path: Path) -> None:
    written = write(run, 10)
    send(run, place=place)
    assert RemoteCheckpoints(place).fetch(checkpoint_name(10), tmp_path / "copy") is None
    assert read_state(tmp_path / "copy") == read_state(written)
    assert {path.relative_to(tmp_path / "copy").as_posix() for path in (tmp_path / "copy").rglob("*.*")} == {
        *FILES, "manifest.json",
    }  # fmt: skip


@pytest.mark.parametrize("name", ["/etc/x", "../x", "a/../../x", ""])
def test_a_manifest_there_names_no_file_outside_its_folder(bucket: Gcs, tmp_path: Path, name: str) -> None:
    manifest = json.dumps({"files": {name: "0"}}).encode()
    bucket.put(f"bucket/run/checkpoints/{checkpoint_name(10)}/manifest.json", manifest)
    problem = RemoteCheckpoints(PLACE).fetch(checkpoint_name(10), tmp_path / "copy")
    assert problem is not None
    assert "it names" in problem
