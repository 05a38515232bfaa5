"""Resume from the mirror: another machine continues the run exactly, whenever the first machine was killed."""

import logging
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from accidents import KilledError, without_permission
from gcs import Gcs
from mirrors import REMOTE, content, names, remote_checkpoints, write
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
FILES = 4  # uploaded before the manifest: the manifest under another name, state.json and two others


@pytest.fixture
def config(make_config: Callable[..., Config]) -> Config:
    return make_config(checkpoint__remote=REMOTE)


def upload_run(gcs: Gcs, config: Config, *steps: int, run_id: str = "mine", **state: object) -> Path:
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


def run_folder(config: Config) -> Path:
    return Path(config.run_dir)


def test_empty_remote_folder_is_tested_and_left_empty(bucket: Gcs, config: Config) -> None:
    assert open_remote(config, SILENT) == config
    assert bucket.names("bucket") == ["other"]
    assert [r.target.split("/")[0] for r in bucket.requests if "write-check" in r.target] == ["POST ", "DELETE "]
    assert len(bucket.uploads()) == 1
    assert not run_folder(config).exists()


def test_new_machine_downloads_the_newest_checkpoint_and_the_small_files(bucket: Gcs, config: Config) -> None:
    source, reporter = upload_run(bucket, config, 5, 10, 20, best_step=10, best_error=0.5), SilentReporter()
    assert open_remote(config, reporter) == config
    newest = newest_checkpoint(run_folder(config) / "checkpoints")
    assert newest is not None
    assert newest.name == checkpoint_name(20)
    assert read_state(newest).run_id == "mine"
    expected = {name: data for name, data in content(source).items() if checkpoint_name(5) not in name}
    assert content(run_folder(config)) == expected
    assert reporter.notes == [
        f"{REMOTE} is writable. It is updated every 30 minutes, and at the end of the run.",
        f"Downloaded {checkpoint_name(20)} from {REMOTE}.",
    ]
    check_run_folder(config)


@pytest.mark.parametrize("damage", ["flip", "remove", "manifest"])
def test_damaged_remote_checkpoint_is_skipped_with_a_warning(
    bucket: Gcs, config: Config, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    upload_run(bucket, config, 10, 20)
    name = "manifest.json" if damage == "manifest" else "optimizer.pt"
    damaged_file = f"run/checkpoints/{checkpoint_name(20)}/{name}"
    data = bytearray(storage.read_bytes(f"gs://bucket/{damaged_file}"))
    if damage == "remove":
        storage.remove(f"gs://bucket/{damaged_file}")
    else:
        data[5] ^= 1
        bucket.put(f"bucket/{damaged_file}", bytes(data) if damage == "flip" else b"{")
    open_remote(config, SILENT)
    assert [path.name for path in (run_folder(config) / "checkpoints").iterdir()] == [checkpoint_name(10)]
    assert remote_checkpoints(REMOTE) == [checkpoint_name(10)], "the damaged checkpoint is removed"
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert f"{REMOTE}: {checkpoint_name(20)}" in caplog.text


@pytest.mark.parametrize("name", ["state.json", "manifest.json", "optimizer.pt"])
@pytest.mark.parametrize("local_step", [None, 10])
def test_unreadable_remote_checkpoint_raises_and_is_kept(
    make_config: MakeConfig, tmp_path: Path, name: str, local_step: int | None
) -> None:
    remote = tmp_path / "disk/run"
    config = make_config(checkpoint__remote=str(remote))
    for step in (10, 20):
        write(remote, step)
    (remote / "config.yaml").write_text(config_as_yaml(config))
    if local_step is not None:
        write(run_folder(config), local_step)
    before = content(remote)
    unreadable = remote / "checkpoints" / checkpoint_name(20) / name
    with without_permission(unreadable), pytest.raises((InputError, RefusedError, PermissionError), match="Permission"):
        open_remote(config, SILENT)
    assert content(remote) == before
    assert [path.name for path in (run_folder(config) / "checkpoints").glob("step-*")] == [checkpoint_name(10)] * bool(
        local_step
    )


@pytest.mark.parametrize(("local_step", "remote_step", "expected"), [(10, 20, 20), (20, 10, 20), (20, 20, 20)])
def test_run_resumes_from_the_later_of_local_and_remote_checkpoint(
    bucket: Gcs, config: Config, local_step: int, remote_step: int, expected: int
) -> None:
    upload_run(bucket, config, remote_step)
    write(run_folder(config), local_step)
    (run_folder(config) / "config.yaml").write_text(config_as_yaml(config))
    open_remote(config, SILENT)
    assert newest_checkpoint(run_folder(config) / "checkpoints").name == checkpoint_name(expected)
    assert bool(bucket.bytes_read("optimizer.pt")) == (remote_step > local_step)


def test_remote_run_with_another_config_raises(bucket: Gcs, config: Config) -> None:
    upload_run(bucket, config, 10)
    training = config.training.model_copy(update={"learning_rate": 0.5})
    other = config.model_copy(update={"training": training})
    with pytest.raises(InputError, match=rf"{REMOTE}: a run with another config; it differs in training.learning_rate"):
        open_remote(other, SILENT)
    assert not run_folder(config).exists(), "nothing may be downloaded"
    open_remote(other, SILENT, allow_config_change=True)
    assert newest_checkpoint(run_folder(config) / "checkpoints") is not None


def test_remote_folder_of_another_run_raises(bucket: Gcs, config: Config) -> None:
    upload_run(bucket, config, 10, run_id="other")
    before = bucket.names("bucket")
    write(run_folder(config), 20)
    with pytest.raises(
        InputError, match=rf"{REMOTE} contains a checkpoint of another run, {checkpoint_name(10)}.*Set an"
    ):
        open_remote(config, SILENT)
    assert bucket.names("bucket") == before


def test_unreachable_remote_folder_causes_a_warning(
    bucket: Gcs, config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    bucket.fail_next(503, times=99)
    assert open_remote(config, SILENT) == config
    assert len(bucket.requests) == 5, "no further request may follow the failed one"
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "HTTP 503" in caplog.text
    assert "the state on this machine (no checkpoint)" in caplog.text


def test_failed_download_of_a_remote_checkpoint_raises(
    bucket: Gcs, config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    upload_run(bucket, config, 20)
    bucket.fail_next(503, times=99, match="/download/.*optimizer")
    with pytest.raises(UnreachableError, match="optimizer"):
        open_remote(config, SILENT)
    caplog.clear()
    write(run_folder(config), 10)
    assert open_remote(config, SILENT) == config
    assert f"the state on this machine (step 10; {checkpoint_name(20)} is newer)" in caplog.text


def test_failed_download_of_a_remote_run_without_checkpoint_raises(bucket: Gcs, config: Config) -> None:
    upload_run(bucket, config, 20)
    RemoteCheckpoints(REMOTE).remove(checkpoint_name(20))
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
    folder = run_folder(make_config())
    with pytest.raises(InputError, match="a folder outside run_dir"):
        open_remote(make_config(checkpoint__remote=str(folder / inner)), SILENT)


def test_run_folder_is_locked_before_a_download(bucket: Gcs, config: Config) -> None:
    """With two simultaneous starts, the second one would overwrite newer metrics of the first."""
    upload_run(bucket, config, 10)
    with RunLock(run_folder(config)) as first, RunLock(run_folder(config)) as second:
        first.take()
        before = content(run_folder(config))
        with pytest.raises(InputError, match="in use by"):
            open_remote(config, SILENT, lock=second)
        assert content(run_folder(config)) == before
    with RunLock(run_folder(config)) as lock:
        open_remote(config, SILENT, lock=lock)
        with RunLock(run_folder(config)) as other, pytest.raises(InputError, match="in use by"):
            other.take()


def test_interrupted_download_starts_again(bucket: Gcs, config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    source, download = upload_run(bucket, config, 10), storage.download

    def killed(source: str, target: Path) -> None:
        if "optimizer" in source:
            raise KilledError
        download(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(storage, "download", killed)
        with pytest.raises(KilledError):
            open_remote(config, SILENT)
    assert newest_checkpoint(run_folder(config) / "checkpoints") is None
    check_run_folder(config)
    open_remote(config, SILENT)
    assert content(run_folder(config)) == content(source)


# A run that resumes on another machine


@pytest.fixture
def config_on(make_config: MakeConfig, tmp_path: Path) -> MakeConfig:
    """Return a function that makes the config of a machine, which uploads each checkpoint immediately."""

    def config(machine: str, remote: str = REMOTE, **changes: object) -> Config:
        defaults = {"checkpoint__remote_every_minutes": 0.0, "checkpoint__keep_best": "off"}
        return make_config(run_dir=str(tmp_path / machine), checkpoint__remote=remote, **(defaults | changes))

    return config


def stop_after(step: int, config: Config, reporter) -> None:
    with pytest.raises(StoppedError):
        train(config, signalled_reporter(type(reporter)(), step, signal.SIGTERM))


@pytest.mark.usefixtures("bucket", "default_signals")
def test_resume_on_a_new_machine_after_preemption_is_exact(
    config_on: MakeConfig, reporter, tmp_path: Path, whole_run: Path
) -> None:
    stop_after(3, config_on("one"), reporter)
    assert remote_checkpoints(REMOTE)[-1] == checkpoint_name(3), "the upload must precede the end of the process"
    shutil.rmtree(tmp_path / "one")
    train(config_on("two"), reporter)
    assert reporter.steps == [4, 5, 6]
    assert_same_run(whole_run, tmp_path / "two")
    assert remote_checkpoints(REMOTE)[-1] == checkpoint_name(6)
    train(config_on("three"), reporter)
    assert reporter.steps == [4, 5, 6], "a finished run must not be trained again on another machine"
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
    assert "HTTP 503" in warnings[1], "all failed uploads cause only one warning"
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
    assert remote_checkpoints(REMOTE)[-1] == checkpoint_name(4)


# A machine that is killed during an upload


@pytest.fixture
def remote(tmp_path: Path) -> str:
    return str(tmp_path / "disk/run")


def kill_during_upload(config: object, reporter, monkeypatch: pytest.MonkeyPatch, *, before_file: int) -> None:
    """Train, and simulate a kill before the upload of checkpoint file number `before_file`."""
    uploaded, original = list[str](), storage.upload

    def upload(source: Path, target: str) -> None:
        if "/checkpoints/" in target:
            if len(uploaded) == before_file:
                raise KilledError
            uploaded.append(target)
        original(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(storage, "upload", upload)
        patch.setattr(Mirror, "_start_pass", Mirror._run_pass)  # in the main thread, so that the exception ends the run
        with pytest.raises(KilledError):
            train(config, reporter)
    assert len(uploaded) == before_file


@pytest.mark.parametrize(
    ("before_file", "machine", "complete"),
    [(2, "another", []), (FILES, "another", []), (2, "this", []), (FILES + 3, "another", [2])],
)
def test_run_killed_during_an_upload_resumes_from_the_last_complete_checkpoint(
    config_on,
    reporter,
    monkeypatch,
    tmp_path: Path,
    remote: str,
    before_file,
    machine,
    complete,
    caplog,
    whole_run: Path,
) -> None:
    kill_during_upload(config_on("this", remote), reporter, monkeypatch, before_file=before_file)
    assert remote_checkpoints(remote) == names(*complete)
    next_start = type(reporter)()
    train(config_on(machine, remote), next_start)
    assert machine == "this" or next_start.steps[0] == max(complete, default=0) + 1
    assert remote_checkpoints(remote)[-1] == checkpoint_name(6)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert_same_run(whole_run, tmp_path / machine)


def test_incomplete_remote_checkpoint_of_another_run_raises_before_the_first_step(
    config_on, reporter, monkeypatch, tmp_path: Path, remote: str
) -> None:
    kill_during_upload(config_on("this", remote), reporter, monkeypatch, before_file=2)
    reporter.steps.clear()
    with pytest.raises(InputError, match=r"differs in training\.learning_rate.*Set another checkpoint.remote"):
        train(config_on("other", remote, training__learning_rate=0.5), reporter)
    assert not (tmp_path / "other").exists()
    assert reporter.steps == []


def test_remote_small_files_without_a_checkpoint_do_not_block_a_new_run(config_on, reporter, remote: str) -> None:
    """After removing the remote checkpoints, a user can start a new run there, also with another config."""
    train(config_on("this", remote), reporter)
    for name in remote_checkpoints(remote):
        RemoteCheckpoints(remote).remove(name)
    assert {"config.yaml", "run_id"} <= {name for name in SMALL_FILES if storage.exists(storage.join(remote, name))}
    train(config_on("other", remote, training__learning_rate=0.5), reporter)
    assert remote_checkpoints(remote)[-1] == checkpoint_name(6)
