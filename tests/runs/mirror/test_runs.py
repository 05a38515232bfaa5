"""Resuming from the mirror: another machine continues the run without a difference."""

import logging
import os
import shutil
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from gcs import Gcs
from same_run import assert_same_run
from vjepa2_ac import storage
from vjepa2_ac.config import Config
from vjepa2_ac.distributed.signals import StoppedError
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import checkpoint_name
from vjepa2_ac.runs.mirror.remote_checkpoints import RemoteCheckpoints, complete
from vjepa2_ac.training.loop import train

PLACE = "gs://bucket/run"

MakeConfig = Callable[..., Config]


class KilledError(BaseException):
    """Stands for SIGKILL: nobody sees to anything any more."""


pytestmark = pytest.mark.usefixtures("default_signals")


@pytest.fixture(autouse=True)
def _bucket(gcs: Gcs) -> None:
    gcs.put("bucket/other", b"1")
    gcs.forget()


def mirrored(make_config: MakeConfig, tmp_path: Path, machine: str, **changes: object) -> Config:
    return make_config(
        run_dir=str(tmp_path / machine), checkpoint__remote=PLACE, checkpoint__remote_every_minutes=0.0, **changes
    )


def at_step(reporter, step: int, action: Callable[[], None]):
    """Return another reporter that does something when a step is done, before its checkpoint is written."""
    other = type(reporter)()
    stepped = other.stepped

    def then(done: int, metrics: dict) -> None:
        stepped(done, metrics)
        if done == step:
            action()

    other.stepped = then
    return other


def wait_for_mirrors() -> None:
    """Wait until what is being sent is there, and nothing is being sent."""
    for thread in threading.enumerate():
        if thread.name == "mirror":
            thread.join(120)
            assert not thread.is_alive()


def there() -> list[str]:
    return sorted(complete(RemoteCheckpoints(PLACE).listing()))


def stop_after(step: int, config: Config, reporter) -> None:
    with pytest.raises(StoppedError):
        train(config, at_step(reporter, step, lambda: os.kill(os.getpid(), signal.SIGTERM)))


def test_after_preemption_a_fresh_machine_goes_on_as_if_nothing_had_happened(
    make_config: MakeConfig, reporter, tmp_path: Path, whole_run: Path
) -> None:
    stop_after(3, mirrored(make_config, tmp_path, "one"), reporter)
    assert there()[-1] == checkpoint_name(3), "sent before the process ends"
    shutil.rmtree(tmp_path / "one")
    train(mirrored(make_config, tmp_path, "two"), reporter)
    assert reporter.steps == [4, 5, 6]
    assert_same_run(whole_run, tmp_path / "two")
    assert there()[-1] == checkpoint_name(6)
    train(mirrored(make_config, tmp_path, "three"), reporter)
    assert reporter.steps == [4, 5, 6], "a run that is done is done everywhere"
    assert_same_run(whole_run, tmp_path / "three")


def test_a_machine_killed_while_sending_leaves_the_last_complete_checkpoint_to_the_next(
    make_config: MakeConfig, reporter, tmp_path: Path, whole_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fourth_is_on_its_way, dead = threading.Event(), threading.Event()

    def upload(source: Path, target: str) -> None:
        if f"{checkpoint_name(4)}/optimizer.pt" in target:
            fourth_is_on_its_way.set()
            assert dead.wait(120)
            raise OSError("the process is gone")
        storage.upload(source, target)

    def die() -> None:
        assert fourth_is_on_its_way.wait(120)
        raise KilledError

    monkeypatch.setattr("vjepa2_ac.runs.mirror.remote_checkpoints.upload", upload)
    config = mirrored(make_config, tmp_path, "one", checkpoint__keep_best=False)
    dying = at_step(reporter, 6, die)
    stepped = dying.stepped
    dying.stepped = lambda step, seen: (stepped(step, seen), step == 3 and wait_for_mirrors())
    with pytest.raises(KilledError):
        train(config, dying)
    dead.set()
    assert there() == [checkpoint_name(2)]
    train(mirrored(make_config, tmp_path, "two", checkpoint__keep_best=False), reporter)
    assert reporter.steps == [3, 4, 5, 6]
    assert_same_run(whole_run, tmp_path / "two")


def test_a_damaged_checkpoint_there_costs_the_steps_after_the_one_before(
    gcs: Gcs, make_config: MakeConfig, reporter, tmp_path: Path, whole_run: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stop_after(3, mirrored(make_config, tmp_path, "one", checkpoint__keep_best=False), reporter)
    stop_after(5, mirrored(make_config, tmp_path, "one", checkpoint__keep_best=False), reporter)
    gcs.put(f"bucket/run/checkpoints/{checkpoint_name(5)}/optimizer.pt", b"?")
    train(mirrored(make_config, tmp_path, "two", checkpoint__keep_best=False), reporter)
    assert reporter.steps[0] in {4, 5}  # 4, too, may have been sent
    assert f"{checkpoint_name(5)}: optimizer.pt is damaged" in caplog.text
    assert_same_run(whole_run, tmp_path / "two")


def test_a_place_that_is_down_for_the_whole_run_costs_warnings_and_no_step(
    gcs: Gcs, make_config: MakeConfig, reporter, tmp_path: Path, whole_run: Path, caplog: pytest.LogCaptureFixture
) -> None:
    gcs.fail_next(503, times=10_000)
    caplog.clear()
    train(mirrored(make_config, tmp_path, "one"), reporter)
    assert reporter.steps == [1, 2, 3, 4, 5, 6]
    assert_same_run(whole_run, tmp_path / "one")
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warnings) == 2
    assert "HTTP 503" in warnings[0]
    assert "is on this machine only" in warnings[1]
    assert gcs.names("bucket") == ["other"]


def test_a_check_tries_the_place_and_leaves_nothing_there_or_here(
    gcs: Gcs, make_config: MakeConfig, reporter, tmp_path: Path
) -> None:
    config = mirrored(make_config, tmp_path, "one")
    train(config, reporter, check_only=True)
    assert [r.target for r in gcs.requests if r.target.startswith("DELETE") and ".write-check-" in r.target]
    assert gcs.names("bucket") == ["other"]
    gcs.fail_next(403, times=99, match="POST /upload/")
    with pytest.raises(InputError, match="no permission"):
        train(config, reporter, check_only=True)
    gcs.forget()
    stop_after(2, mirrored(make_config, tmp_path, "two"), reporter)
    before = gcs.names("bucket")
    train(config, reporter, check_only=True)
    assert any(note.startswith("Going on from") for note in reporter.notes)
    assert gcs.names("bucket") == before
    assert not Path(config.run_dir).exists()


def test_two_runs_do_not_share_a_place(make_config: MakeConfig, reporter, tmp_path: Path) -> None:
    stop_after(2, mirrored(make_config, tmp_path, "one"), reporter)
    stop_after(1, make_config(run_dir=str(tmp_path / "two")), reporter)
    with pytest.raises(InputError, match="another run"):
        train(mirrored(make_config, tmp_path, "two"), reporter)
    with pytest.raises(InputError, match=r"differs in training\.learning_rate"):
        train(mirrored(make_config, tmp_path, "three", training__learning_rate=0.5), reporter)
    assert reporter.steps == []
    assert not (tmp_path / "three").exists()


def test_a_run_that_fails_sends_its_last_checkpoint(make_config: MakeConfig, reporter, tmp_path: Path) -> None:
    def fail() -> None:
        raise InputError(where="here", found="a loss that is not finite")

    changes = {"checkpoint__remote_every_minutes": 1e6, "checkpoint__keep_best": False}
    config = make_config(run_dir=str(tmp_path / "one"), checkpoint__remote=PLACE, **changes)
    with pytest.raises(InputError, match="not finite"):
        train(config, at_step(reporter, 5, fail))
    assert there()[-1] == checkpoint_name(4)
