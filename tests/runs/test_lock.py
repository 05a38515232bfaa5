"""The lock: one process trains in a folder at a time, and a dead one never blocks it."""

import errno
import fcntl
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import newest_checkpoint
from vjepa2_ac.runs.lock import LOCK, RunLock
from vjepa2_ac.training import loop
from vjepa2_ac.training.loop import train

HOLD = """
import sys, time
from pathlib import Path
from vjepa2_ac.runs.lock import RunLock
lock = RunLock(Path(sys.argv[1]))
lock.take()
print("held", flush=True)
sys.stdin.read()
"""


def holder(folder: Path) -> subprocess.Popen:
    """Start a process that holds the lock of a folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    return process


def test_a_folder_in_use_is_refused_and_its_process_named_until_it_is_killed(tmp_path: Path) -> None:
    with holder(tmp_path / "run") as process:
        with (
            RunLock(tmp_path / "run") as lock,
            pytest.raises(InputError, match=rf"being trained right now, by process {process.pid} on .+, since 20"),
        ):
            lock.take()
        process.send_signal(signal.SIGKILL)
        assert process.wait(timeout=120) == -signal.SIGKILL
    with RunLock(tmp_path / "run") as lock:
        lock.take()
        assert f'"process": {os.getpid()}' in (tmp_path / "run" / LOCK).read_text()


def test_within_a_process_too_it_is_held_once_and_given_back(tmp_path: Path) -> None:
    with RunLock(tmp_path) as lock:
        lock.take()
        lock.take()
        with RunLock(tmp_path) as other, pytest.raises(InputError, match="being trained right now"):
            other.take()
        with RunLock(tmp_path) as other, pytest.raises(InputError, match="being trained right now"):
            other.take()
    with RunLock(tmp_path) as lock:
        lock.take()
        with RunLock(tmp_path) as other, pytest.raises(InputError, match=rf"by process {os.getpid()} on"):
            other.take()  # the last to sign is named, not those before


def test_a_lock_that_nobody_took_leaves_no_trace(tmp_path: Path) -> None:
    with RunLock(tmp_path / "run"):
        pass
    assert not (tmp_path / "run").exists()


def test_an_unreadable_signature_is_another_process(tmp_path: Path) -> None:
    with RunLock(tmp_path) as lock:
        lock.take()
        (tmp_path / LOCK).write_text("")
        with RunLock(tmp_path) as other, pytest.raises(InputError, match="by another process"):
            other.take()


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS])
def test_a_file_system_without_locks_costs_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, number: int
) -> None:
    def refuse(file: object, operation: int) -> None:
        del file, operation
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with caplog.at_level(logging.WARNING), RunLock(tmp_path) as lock:
        lock.take()
    assert "has no locks" in caplog.text


def test_a_folder_that_cannot_be_made_is_the_users_to_mend(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with RunLock(tmp_path / "file" / "run") as lock, pytest.raises(InputError, match="cannot be written"):
        lock.take()


def test_a_run_holds_its_folder_while_it_trains_and_gives_it_back(make_config, reporter) -> None:
    refused = []

    def try_to_train_too(step: int, metrics: object) -> None:
        del metrics
        with pytest.raises(InputError, match=rf"by process {os.getpid()}"):
            train(make_config(training__steps=2), other)
        refused.append(step)

    other, reporter.stepped = type(reporter)(), try_to_train_too
    train(make_config(training__steps=2), reporter)
    assert refused == [1, 2]
    assert other.notes == [], "refused before anything was loaded"
    train(make_config(training__steps=2), other)


def test_a_check_needs_no_lock(make_config, reporter) -> None:
    config = make_config(training__steps=2)
    with RunLock(Path(config.run_dir)) as lock:
        lock.take()
        train(config, reporter, check_only=True)
    assert "Everything is in place" in reporter.notes[-1]


def test_a_start_that_another_one_overtook_leaves_its_run_alone(make_config, reporter, monkeypatch) -> None:
    config, restore = make_config(), loop.restore

    def overtaken(*arguments):
        run = restore(*arguments)
        monkeypatch.setattr(loop, "restore", restore)
        train(config, type(reporter)())
        return run

    monkeypatch.setattr(loop, "restore", overtaken)
    with pytest.raises(InputError, match="step 6, which another start wrote while this one stood at 0"):
        train(config, reporter)
    assert newest_checkpoint(Path(config.run_dir) / "checkpoints").name == "step-00000006"
