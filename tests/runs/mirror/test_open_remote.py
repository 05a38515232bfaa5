"""Opening the mirror: before the first step its owner, access and newer checkpoints are known."""

import logging
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from gcs import Failure, Gcs
from run_fixtures import SilentReporter
from vjepa2_ac import storage
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.errors import InputError, UnreachableError
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.checkpoint import RunState, checkpoint_name, newest_checkpoint, read_state, write_checkpoint
from vjepa2_ac.runs.folder import RunLock, check_run_folder
from vjepa2_ac.runs.mirror.open_remote import Remote, open_remote

PLACE = "gs://bucket/run"


@pytest.fixture
def bucket(gcs: Gcs) -> Gcs:
    gcs.put("bucket/other", b"1")
    gcs.forget()
    return gcs


@pytest.fixture
def config(make_config: Callable[..., Config]) -> Config:
    return make_config(checkpoint__remote=PLACE)


def write(run: Path, step: int, run_id: str = "mine", **state: object) -> Path:
    def files(folder: Path) -> None:
        (folder / "adapter").mkdir()
        (folder / "adapter/weights.bin").write_bytes(f"weights {step} ".encode() * 100)
        (folder / "optimizer.pt").write_bytes(f"moments {step} ".encode() * 200)

    return write_checkpoint(run / "checkpoints", RunState(step, run_id, clips_done=step, **state), files, keep=9)


def run_there(gcs: Gcs, config: Config, *steps: int, run_id: str = "mine", **state: object) -> Path:
    """Put a run with these checkpoints at the place; return the folder it was put from."""
    folder = Path(config.run_dir).parent / f"elsewhere-{run_id}"
    for step in steps:
        write(folder, step, run_id, **state)
    (folder / "config.yaml").write_text(config_as_yaml(config))
    (folder / "run_id").write_text(run_id)
    (folder / "metrics.jsonl").write_text("".join(f'{{"kind": "train", "step": {step}}}\n' for step in steps))
    gcs.upload(folder, "bucket/run")
    gcs.forget()
    return folder


def local(config: Config) -> Path:
    return Path(config.run_dir)


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_empty_place_is_tried_and_left_empty(bucket: Gcs, config: Config) -> None:
    assert open_remote(config, SILENT) == Remote(PLACE, config)
    assert bucket.names("bucket") == ["other"]
    assert [r.target.split("/")[0] for r in bucket.requests if "write-check" in r.target] == ["DELETE "]
    assert len(bucket.uploads()) == 1
    assert not local(config).exists()


def test_a_fresh_machine_gets_the_newest_checkpoint_and_the_small_files(bucket: Gcs, config: Config) -> None:
    source, reporter = run_there(bucket, config, 5, 10, 20, best_step=10, best_error=0.5), SilentReporter()
    remote = open_remote(config, reporter)
    assert remote == Remote(PLACE, config)
    newest = newest_checkpoint(local(config) / "checkpoints")
    assert newest is not None
    assert newest.name == checkpoint_name(20)
    assert read_state(newest).run_id == "mine"
    expected = {name: data for name, data in files_of(source).items() if checkpoint_name(5) not in name}
    assert files_of(local(config)) == expected
    assert reporter.notes == [
        f"{PLACE} can be written: it is brought up to date every 30 minutes, and in the end.",
        f"Fetched {checkpoint_name(20)} from {PLACE}.",
    ]
    check_run_folder(config)


@pytest.mark.parametrize("failure", [429, 503, "reset", "cut", "short"])
def test_fetching_survives_what_passes(bucket: Gcs, config: Config, failure: Failure) -> None:
    source = run_there(bucket, config, 10)
    bucket.fail_next(failure, times=4, match="/download/.*optimizer")
    bucket.fail_next(failure, times=4, match="prefix=" if failure != "short" else "never")
    open_remote(config, SILENT)
    assert files_of(local(config)) == files_of(source)


@pytest.mark.parametrize("damage", ["flip", "remove", "manifest"])
def test_a_damaged_checkpoint_there_is_passed_over_by_name(
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
    remote = open_remote(config, SILENT)
    assert [path.name for path in (local(config) / "checkpoints").iterdir()] == [checkpoint_name(10)]
    assert remote.damaged == (checkpoint_name(20),)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert f"{PLACE}: {checkpoint_name(20)}" in caplog.text


@pytest.mark.parametrize(("here", "elsewhere", "taken"), [(10, 20, 20), (20, 10, 20), (20, 20, 20)])
def test_the_further_one_is_taken(bucket: Gcs, config: Config, here: int, elsewhere: int, taken: int) -> None:
    run_there(bucket, config, elsewhere)
    write(local(config), here)
    (local(config) / "config.yaml").write_text(config_as_yaml(config))
    open_remote(config, SILENT)
    assert newest_checkpoint(local(config) / "checkpoints").name == checkpoint_name(taken)
    assert bool(bucket.bytes_read("optimizer.pt")) == (elsewhere > here)


def test_another_config_is_refused_as_if_it_were_on_this_machine(bucket: Gcs, config: Config) -> None:
    run_there(bucket, config, 10)
    training = config.training.model_copy(update={"learning_rate": 0.5})
    other = config.model_copy(update={"training": training})
    with pytest.raises(InputError, match=rf"{PLACE}: a run of another config; it differs in training.learning_rate"):
        open_remote(other, SILENT)
    assert not local(config).exists(), "nothing has come"
    open_remote(other, SILENT, allow_config_change=True)
    assert newest_checkpoint(local(config) / "checkpoints") is not None


def test_another_runs_place_is_refused(bucket: Gcs, config: Config) -> None:
    run_there(bucket, config, 10, run_id="other")
    before = bucket.names("bucket")
    write(local(config), 20)
    with pytest.raises(InputError, match=rf"{PLACE} holds a checkpoint of another run, {checkpoint_name(10)}.*Set an"):
        open_remote(config, SILENT)
    assert bucket.names("bucket") == before


def test_a_place_that_cannot_be_reached_is_a_warning(
    bucket: Gcs, config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    bucket.fail_next(503, times=99)
    remote = open_remote(config, SILENT)
    assert remote == Remote(PLACE, config, is_reachable=False)
    assert len(bucket.requests) == 5, "one call, and no other once it failed"
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "HTTP 503" in caplog.text
    assert "what is on this machine, without a checkpoint" in caplog.text


def test_what_is_seen_there_and_cannot_be_fetched_is_not_done_again_from_the_start(
    bucket: Gcs, config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    run_there(bucket, config, 20)
    bucket.fail_next(503, times=99, match="/download/.*optimizer")
    with pytest.raises(UnreachableError, match="optimizer"):
        open_remote(config, SILENT)
    caplog.clear()
    write(local(config), 10)
    assert open_remote(config, SILENT) == Remote(PLACE, config)
    assert f"Training goes on after step 10, though {checkpoint_name(20)} is there" in caplog.text


@pytest.mark.parametrize(
    ("match", "failure"), [("POST /upload/", 403), ("DELETE", 403), ("prefix=", 403), ("POST /upload/", 401)]
)
def test_a_place_without_permission_is_an_error_with_the_way_out(
    bucket: Gcs, config: Config, match: str, failure: int
) -> None:
    bucket.fail_next(failure, times=9, match=match)
    with pytest.raises(InputError, match=r"^checkpoint.remote: gs://bucket/run: no permission.*Log in.*another place"):
        open_remote(config, SILENT)


def test_a_bucket_that_does_not_exist_is_an_error(bucket: Gcs, make_config: Callable[..., Config]) -> None:
    assert bucket.names("bucket")
    with pytest.raises(InputError, match=r"there is no bucket buckett\..*check its name\. Or name another place"):
        open_remote(make_config(checkpoint__remote="gs://buckett/run"), SILENT)


@pytest.mark.parametrize("inner", ["", "mirror"])
def test_the_runs_own_folder_is_no_mirror(make_config: Callable[..., Config], inner: str) -> None:
    folder = local(make_config())
    with pytest.raises(InputError, match="a place outside the run's folder"):
        open_remote(make_config(checkpoint__remote=str(folder / inner)), SILENT)


def test_a_check_fetches_elsewhere_and_leaves_the_runs_folder_alone(
    bucket: Gcs, config: Config, tmp_path: Path
) -> None:
    run_there(bucket, config, 10, 20)
    write(local(config), 10)
    before = files_of(local(config))
    remote = open_remote(config, SILENT, into=tmp_path / "trial")
    assert remote.config.run_dir == str(tmp_path / "trial")
    assert newest_checkpoint(tmp_path / "trial/checkpoints").name == checkpoint_name(20)
    assert files_of(local(config)) == before
    shutil.rmtree(local(config))
    write(local(config), 30)
    assert open_remote(config, SILENT, into=tmp_path / "other").config == config


def test_a_folder_is_claimed_before_anything_is_fetched_into_it(bucket: Gcs, config: Config) -> None:
    """Two that start at once in a new folder: the second would put older metrics over those of the first."""
    run_there(bucket, config, 10)
    with RunLock(local(config)) as first, RunLock(local(config)) as second:
        first.take()
        before = files_of(local(config))
        with pytest.raises(InputError, match="being trained right now"):
            open_remote(config, SILENT, claim=second.take)
        assert files_of(local(config)) == before
    with RunLock(local(config)) as lock:
        open_remote(config, SILENT, claim=lock.take)
        with RunLock(local(config)) as other, pytest.raises(InputError, match="being trained right now"):
            other.take()


def test_who_is_killed_while_fetching_fetches_again(
    bucket: Gcs, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = run_there(bucket, config, 10)

    class KilledError(BaseException):
        pass

    def killed(source: str, target: Path) -> None:
        if "optimizer" in source:
            raise KilledError
        storage.download(source, target)

    monkeypatch.setattr("vjepa2_ac.runs.mirror.remote_checkpoints.download", killed)
    with pytest.raises(KilledError):
        open_remote(config, SILENT)
    monkeypatch.setattr("vjepa2_ac.runs.mirror.remote_checkpoints.download", storage.download)
    assert newest_checkpoint(local(config) / "checkpoints") is None
    check_run_folder(config)
    open_remote(config, SILENT)
    assert files_of(local(config)) == files_of(source)
