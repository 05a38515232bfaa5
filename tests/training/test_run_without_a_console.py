"""A missing reader, terminal or a full log disk does not stop, delay or change a run. With real processes."""

import os
import pty
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from killable import Child, Nursery
from same_run import assert_same_run
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.process import EXIT_STATUS
from vjepa2_ac.runs.checkpoint import newest_checkpoint
from vjepa2_ac.training.loop import train

CHANGES = {"training__steps": 4, "validation__every": 2, "checkpoint__every": 2, "tracking__tensorboard": True}

Start = Callable[..., Child]


@pytest.fixture(scope="module")
def _whole() -> dict[str, Path]:
    return {}


@pytest.fixture
def whole(_whole: dict[str, Path], make_config, reporter, tmp_path: Path) -> Path:
    """A run that nothing has disturbed."""
    if "run" not in _whole:
        _whole["run"] = train(make_config(run_dir=str(tmp_path / "whole"), **CHANGES), reporter)
    return _whole["run"]


@pytest.fixture
def start(make_config, nursery: Nursery, tmp_path: Path) -> Start:
    def start_run(**streams: str) -> Child:
        config = make_config(run_dir=str(tmp_path / "run"), **CHANGES)
        (tmp_path / "config.yaml").write_text(config_as_yaml(config))
        return nursery.start("train", str(tmp_path / "config.yaml"), folder=tmp_path / "run", **streams)

    return start_run


@pytest.fixture
def pipe(tmp_path: Path) -> Iterator[tuple[str, int]]:
    """A pipe by name, and the end of it that a test may read."""
    path = str(tmp_path / "pipe")
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    yield path, reader
    os.close(reader)


def test_a_run_whose_terminal_is_gone_continues_and_stops_cleanly_on_a_signal(
    start: Start, tmp_path: Path, make_config, reporter, whole: Path
) -> None:
    ours, theirs = pty.openpty()
    child = start(out=os.ttyname(theirs), err=os.ttyname(theirs))
    assert os.read(ours, 10)
    os.close(theirs)  # not before the run has it
    os.close(ours)
    while not (tmp_path / "run" / "metrics.jsonl").exists():
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGHUP)  # what its shell would send it, and the kernel once more
    os.kill(child.pid, signal.SIGHUP)
    status = child.wait()
    assert status in {0, EXIT_STATUS, -signal.SIGHUP}, "done, stopped, or told before the first step"
    train(make_config(run_dir=str(tmp_path / "run"), **CHANGES), reporter)
    assert newest_checkpoint(tmp_path / "run" / "checkpoints").name == "step-00000004"
    assert_same_run(whole, tmp_path / "run")
