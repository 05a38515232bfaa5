"""Resuming from the mirror: another machine continues the run without a difference, whenever the first one died."""

import logging
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from accidents import KilledError, without_permission
from gcs import Gcs
from mirrors import PLACE, content, names, remote_checkpoints, write
from run_fixtures import SilentReporter, at_step, signalled_reporter
from same_run import assert_same_run
from vjepa2_ac import storage
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError
from vjepa2_ac.process import StoppedError
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.checkpoint import RunState, checkpoint_name, newest_checkpoint, read_state
from vjepa2_ac.runs.folder import SMALL_FILES, RunLock, check_run_folder
from vjepa2_ac.runs.mirror import Mirror, RemoteCheckpoints
from vjepa2_ac.runs.open_run import open_remote
from vjepa2_ac.training.loop import train

MakeConfig = Callable[..., Config]
FILES = 4  # the manifest under another name, state.json and two more come before the manifest


@pytest.fixture
def config(make_config: Callable[..., Config]) -> Config:
    return make_config(checkpoint__remote=PLACE)


def run_there(gcs: Gcs, config: Config, *steps: int, run_id: str = "mine", **state: object) -> Path:
    """Upload a run with these checkpoints; return its local folder."""
    folder = Path(config.run_dir).parent / f"uploaded-{run_id}"
    for step in steps:
        write(folder, step, RunState(step, run_id, **state), keep=9)
    (folder / "config.yaml").write_text(config_as_yaml(config))
    (folder / "run_id").write_text(run_id)
    (folder / "metrics.jsonl").write_text("".join(f'{{"kind": "train", "step": {step}}}\n' for step in steps))
    gcs.upload(folder, "bucket/run")
    gcs.forget()
    return folder


def local(config: Config) -> Path:
    return Path(config.run_dir)


def test_empty_remote_folder_is_tested_and_left_empty(bucket: Gcs, config: Config) -> None:
    assert open_remote(config, SILENT) == config
    assert bucket.names("bucket") == ["other"]
    assert [r.target.split("/")[0] for r in bucket.requests if "write-check" in r.target] == ["POST ", "DELETE "]
    assert len(bucket.uploads()) == 1
    assert not local(config).exists()


def test_new_machine_downloads_the_newest_checkpoint_and_the_small_files(bucket: Gcs, config: Config) -> None:
    source, reporter = run_there(bucket, config, 5, 10, 20, best_step=10, best_error=0.5), SilentReporter()
    assert open_remote(config, reporter) == config
    newest = newest_checkpoint(local(config) / "checkpoints")
    assert newest is not None
    assert newest.name == checkpoint_name(20)
    assert read_state(newest).run_id == "mine"
    expected = {name: data for name, data in content(source).items() if checkpoint_name(5) not in name}
    assert content(local(config)) == expected
    assert reporter.notes == [
        f"{PLACE} is writable. It is updated every 30 minutes, and at the end of the run.",
        f"Downloaded {checkpoint_name(20)} from {PLACE}.",
    ]
    check_run_folder(config)


@pytest.mark.parametrize("damage", ["flip", "remove", "manifest"])
def test_damaged_remote_checkpoint_is_skipped_with_a_warning(
    bucket: Gcs, config: Config, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    run_there(bucket, config, 10, 20)
    name = "manifest.json" if damage == "manifest" else "optimizer.pt"
    victim = f"run/checkpoints/{checkpoint_name(20)}/{name}"
    data = bytearray(storage.read_bytes(f"gs://bucket/{victim}"))
    if damage == "remove":
        storage.remove(f"gs://bucket/{victim}")
    else:
        data[5] ^= 1
        bucket.put(f"bucket/{victim}", bytes(data) if damage == "flip" else b"{")
    open_remote(config, SILENT)
    assert [path.name for path in (local(config) / "checkpoints").iterdir()] == [checkpoint_name(10)]
    assert remote_checkpoints(PLACE) == [checkpoint_name(10)], "the damaged checkpoint is removed"
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert f"{PLACE}: {checkpoint_name(20)}" in caplog.text


@pytest.mark.parametrize("name", ["state.json", "manifest.json", "optimizer.pt"])
@pytest.mark.parametrize("here", [None, 10])
def test_unreadable_remote_checkpoint_raises_and_is_kept(
    make_config: MakeConfig, tmp_path: Path, name: str, here: int | None
) -> None:
    place = tmp_path / "disk/run"
    config = make_config(checkpoint__remote=str(place))
    for step in (10, 20):
        write(place, step)
    (place / "config.yaml").write_text(config_as_yaml(config))
    if here is not None:
        write(local(config), here)
    before = content(place)
    refused = place / "checkpoints" / checkpoint_name(20) / name
    with without_permission(refused), pytest.raises((InputError, RefusedError, PermissionError), match="Permission"):
        open_remote(config, SILENT)
    assert content(place) == before
    assert [path.name for path in (local(config) / "checkpoints").glob("step-*")] == [checkpoint_name(10)] * bool(here)


@pytest.mark.parametrize(("here", "remote_step", "expected"), [(10, 20, 20), (20, 10, 20), (20, 20, 20)])
def test_run_resumes_from_the_later_of_local_and_remote_checkpoint(
    bucket: Gcs, config: Config, here: int, remote_step: int, expected: int
) -> None:
    run_there(bucket, config, remote_step)
    write(local(config), here)
    (local(config) / "config.yaml").write_text(config_as_yaml(config))
    open_remote(config, SILENT)
    assert newest_checkpoint(local(config) / "checkpoints").name == checkpoint_name(expected)
    assert bool(bucket.bytes_read("optimizer.pt")) == (remote_step > here)


def test_remote_run_with_another_config_raises(bucket: Gcs, config: Config) -> None:
    run_there(bucket, config, 10)
    training = config.training.model_copy(update={"learning_rate": 0.5})
    other = config.model_copy(update={"training": training})
    with pytest.raises(InputError, match=rf"{PLACE}: a run with another config; it differs in training.learning_rate"):
        open_remote(other, SILENT)
    assert not local(config).exists(), "nothing has come"
    open_remote(other, SILENT, allow_config_change=True)
    assert newest_checkpoint(local(config) / "checkpoints") is not None


def test_remote_folder_of_another_run_raises(bucket: Gcs, config: Config) -> None:
    run_there(bucket, config, 10, run_id="other")
    before = bucket.names("bucket")
    write(local(config), 20)
    with pytest.raises(
        InputError, match=rf"{PLACE} contains a checkpoint of another run, {checkpoint_name(10)}.*Set an"
    ):
        open_remote(config, SILENT)
    assert bucket.names("bucket") == before


def test_unreachable_remote_folder_causes_a_warning(
    bucket: Gcs, config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    bucket.fail_next(503, times=99)
    assert open_remote(config, SILENT) == config
    assert len(bucket.requests) == 5, "one call, and no other once it failed"
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "HTTP 503" in caplog.text
    assert "the state on this machine (no checkpoint)" in caplog.text


def test_failed_download_of_a_remote_checkpoint_raises(
    bucket: Gcs, config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    run_there(bucket, config, 20)
    bucket.fail_next(503, times=99, match="/download/.*optimizer")
    with pytest.raises(UnreachableError, match="optimizer"):
        open_remote(config, SILENT)
    caplog.clear()
    write(local(config), 10)
    assert open_remote(config, SILENT) == config
    assert f"the state on this machine (step 10; {checkpoint_name(20)} is newer)" in caplog.text


def test_failed_download_of_a_remote_run_without_checkpoint_raises(bucket: Gcs, config: Config) -> None:
    run_there(bucket, config, 20)
    RemoteCheckpoints(PLACE).remove(checkpoint_name(20))
    bucket.put(f"bucket/run/checkpoints/{checkpoint_name(20)}/state.json", b'{"run_id": "mine", "step": 20}')
    bucket.fail_next(503, times=99, match="/download/.*config.yaml")
    with pytest.raises(UnreachableError, match=r"config\.yaml"):
        open_remote(config, SILENT)


@pytest.mark.parametrize(
    ("match", "failure"), [("POST /upload/", 403), ("DELETE", 403), ("prefix=", 403), ("POST /upload/", 401)]
)
def test_remote_folder_without_permission_raises_with_a_fix(
    bucket: Gcs, config: Config, match: str, failure: int
) -> None:
    bucket.fail_next(failure, times=9, match=match)
    with pytest.raises(
        InputError, match=r"^checkpoint.remote: gs://bucket/run\S*: no permission.*Log in.*another checkpoint.remote"
    ):
        open_remote(config, SILENT)


def test_missing_bucket_raises(bucket: Gcs, make_config: Callable[..., Config]) -> None:
    assert bucket.names("bucket")
    with pytest.raises(
        InputError, match=r"bucket buckett does not exist\..*check its name\. Or set another checkpoint.remote"
    ):
        open_remote(make_config(checkpoint__remote="gs://buckett/run"), SILENT)


@pytest.mark.parametrize("inner", ["", "mirror"])
def test_mirror_inside_the_run_folder_raises(make_config: Callable[..., Config], inner: str) -> None:
    folder = local(make_config())
    with pytest.raises(InputError, match="a folder outside run_dir"):
        open_remote(make_config(checkpoint__remote=str(folder / inner)), SILENT)


def test_run_folder_is_locked_before_a_download(bucket: Gcs, config: Config) -> None:
    """With two simultaneous starts, the second one would overwrite newer metrics of the first."""
    run_there(bucket, config, 10)
    with RunLock(local(config)) as first, RunLock(local(config)) as second:
        first.take()
        before = content(local(config))
        with pytest.raises(InputError, match="in use by"):
            open_remote(config, SILENT, lock=second)
        assert content(local(config)) == before
    with RunLock(local(config)) as lock:
        open_remote(config, SILENT, lock=lock)
        with RunLock(local(config)) as other, pytest.raises(InputError, match="in use by"):
            other.take()


def test_interrupted_download_starts_again(bucket: Gcs, config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    source, download = run_there(bucket, config, 10), storage.download

    def killed(source: str, target: Path) -> None:
        if "optimizer" in source:
            raise KilledError
        download(source, target)

    with monkeypatch.context() as dying:
        dying.setattr(storage, "download", killed)
        with pytest.raises(KilledError):
            open_remote(config, SILENT)
    assert newest_checkpoint(local(config) / "checkpoints") is None
    check_run_folder(config)
    open_remote(config, SILENT)
    assert content(local(config)) == content(source)


# A run that resumes on another machine


@pytest.fixture
def config_on(make_config: MakeConfig, tmp_path: Path) -> MakeConfig:
    """Return a function that makes the config of a machine, which uploads each checkpoint immediately."""

    def config(machine: str, place: str = PLACE, **changes: object) -> Config:
        usual = {"checkpoint__remote_every_minutes": 0.0, "checkpoint__keep_best": "off"}
        return make_config(run_dir=str(tmp_path / machine), checkpoint__remote=place, **(usual | changes))

    return config


def stop_after(step: int, config: Config, reporter) -> None:
    with pytest.raises(StoppedError):
        train(config, signalled_reporter(type(reporter)(), step, signal.SIGTERM))


@pytest.mark.usefixtures("bucket", "default_signals")
def test_resume_on_a_new_machine_after_preemption_is_exact(
    config_on: MakeConfig, reporter, tmp_path: Path, whole_run: Path
) -> None:
    stop_after(3, config_on("one"), reporter)
    assert remote_checkpoints(PLACE)[-1] == checkpoint_name(3), "sent before the process ends"
    shutil.rmtree(tmp_path / "one")
    train(config_on("two"), reporter)
    assert reporter.steps == [4, 5, 6]
    assert_same_run(whole_run, tmp_path / "two")
    assert remote_checkpoints(PLACE)[-1] == checkpoint_name(6)
    train(config_on("three"), reporter)
    assert reporter.steps == [4, 5, 6], "a run that is done is done everywhere"
    assert_same_run(whole_run, tmp_path / "three")


@pytest.mark.usefixtures("bucket", "default_signals")
def test_unreachable_remote_folder_causes_warnings_and_loses_no_step(
    bucket: Gcs, config_on: MakeConfig, reporter, tmp_path: Path, whole_run: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bucket.fail_next(503, times=10_000)
    caplog.clear()
    train(config_on("one"), reporter)
    assert reporter.steps == [1, 2, 3, 4, 5, 6]
    assert_same_run(whole_run, tmp_path / "one")
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warnings) == 3
    assert "HTTP 503" in warnings[0]
    assert "HTTP 503" in warnings[1], "once more, however often it is tried"
    assert "are only on this machine" in warnings[2]
    assert bucket.names("bucket") == ["other"]


@pytest.mark.usefixtures("bucket", "default_signals")
def test_check_tests_the_remote_folder_and_writes_nothing(bucket: Gcs, config_on: MakeConfig, reporter) -> None:
    config = config_on("one")
    train(config, reporter, check_only=True)
    assert [r.target for r in bucket.requests if r.target.startswith("DELETE") and ".write-check-" in r.target]
    assert bucket.names("bucket") == ["other"]
    bucket.fail_next(403, times=99, match="POST /upload/")
    with pytest.raises(InputError, match="no permission"):
        train(config, reporter, check_only=True)
    bucket.forget()
    stop_after(2, config_on("two"), reporter)
    before = bucket.names("bucket")
    train(config, reporter, check_only=True)
    assert any(note.startswith("Resuming from") for note in reporter.notes)
    assert bucket.names("bucket") == before
    assert not Path(config.run_dir).exists()


@pytest.mark.usefixtures("bucket", "default_signals")
def test_failing_run_uploads_its_last_checkpoint(config_on: MakeConfig, reporter) -> None:
    def fail() -> None:
        raise InputError(where="here", found="a loss that is not finite")

    with pytest.raises(InputError, match="not finite"):
        train(config_on("one", checkpoint__remote_every_minutes=1e6), at_step(reporter, 5, fail))
    assert remote_checkpoints(PLACE)[-1] == checkpoint_name(4)


# A machine killed in an upload


@pytest.fixture
def place(tmp_path: Path) -> str:
    return str(tmp_path / "disk/run")


def die_in_upload(config: object, reporter, monkeypatch: pytest.MonkeyPatch, *, before_file: int) -> None:
    """Train, and simulate a kill before the upload of checkpoint file number `before_file`."""
    sent, real = list[str](), storage.upload

    def upload(source: Path, target: str) -> None:
        if "/checkpoints/" in target:
            if len(sent) == before_file:
                raise KilledError
            sent.append(target)
        real(source, target)

    with monkeypatch.context() as dying:
        dying.setattr(storage, "upload", upload)
        dying.setattr(Mirror, "_start_pass", Mirror._run_pass)  # in the thread of the run, so that its end ends the run
        with pytest.raises(KilledError):
            train(config, reporter)
    assert len(sent) == before_file


@pytest.mark.parametrize(
    ("before_file", "machine", "complete"),
    [(2, "another", []), (FILES, "another", []), (2, "this", []), (FILES + 3, "another", [2])],
)
def test_run_killed_during_an_upload_resumes_from_the_last_complete_checkpoint(
    config_on,
    reporter,
    monkeypatch,
    tmp_path: Path,
    place: str,
    before_file,
    machine,
    complete,
    caplog,
    whole_run: Path,
) -> None:
    die_in_upload(config_on("this", place), reporter, monkeypatch, before_file=before_file)
    assert remote_checkpoints(place) == names(*complete)
    next_start = type(reporter)()
    train(config_on(machine, place), next_start)
    assert machine == "this" or next_start.steps[0] == max(complete, default=0) + 1
    assert remote_checkpoints(place)[-1] == checkpoint_name(6)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert_same_run(whole_run, tmp_path / machine)


def test_incomplete_remote_checkpoint_of_another_run_raises_before_the_first_step(
    config_on, reporter, monkeypatch, tmp_path: Path, place: str
) -> None:
    die_in_upload(config_on("this", place), reporter, monkeypatch, before_file=2)
    reporter.steps.clear()
    with pytest.raises(InputError, match=r"differs in training\.learning_rate.*Set another checkpoint.remote"):
        train(config_on("other", place, training__learning_rate=0.5), reporter)
    assert not (tmp_path / "other").exists()
    assert reporter.steps == []


def test_remote_small_files_without_a_checkpoint_do_not_block_a_new_run(config_on, reporter, place: str) -> None:
    """After removing the remote checkpoints, a user can start a new run there, also with another config."""
    train(config_on("this", place), reporter)
    for name in remote_checkpoints(place):
        RemoteCheckpoints(place).remove(name)
    assert {"config.yaml", "run_id"} <= {name for name in SMALL_FILES if storage.exists(storage.join(place, name))}
    train(config_on("other", place, training__learning_rate=0.5), reporter)
    assert remote_checkpoints(place)[-1] == checkpoint_name(6)
