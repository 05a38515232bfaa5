"""Slow disks: a run waits for them with a message, and its results do not change."""

import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from same_run import assert_same_run
from vjepa2_ac.runs import slow_disk
from vjepa2_ac.runs.slow_disk import warn_if_stalled
from vjepa2_ac.training.loop import train


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture) -> Callable[[], list[str]]:
    caplog.clear()
    return lambda: [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING and "the disk" in r.message]


def wait_until(happens: Callable[[], object]) -> None:
    until = time.monotonic() + 120
    while not happens():
        assert time.monotonic() < until
        time.sleep(0.002)


@pytest.mark.parametrize(
    ("call", "file"), [("write", "metrics.jsonl"), ("fsync", "metrics.jsonl"), ("fsync", "checkpoints/")]
)
def test_a_run_on_a_disk_that_stalls_says_so_and_goes_on(
    make_config, reporter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said, call: str, file: str
) -> None:
    train(make_config(run_dir=str(tmp_path / "whole"), training__steps=2), reporter)
    real, main, stalls = getattr(os, call), threading.main_thread(), []

    def stalling(handle: int, *arguments: object) -> object:
        if not stalls and f"stalled/{file}" in str(Path(f"/proc/self/fd/{handle}").readlink()):
            stalls.append(handle)
            assert threading.current_thread() is main
            wait_until(said)  # nothing but the warning ends it
        return real(handle, *arguments)

    monkeypatch.setattr(slow_disk, "STALLED_S", 0.3)
    monkeypatch.setattr(os, call, stalling)
    train(make_config(run_dir=str(tmp_path / "stalled"), training__steps=2), reporter)
    assert len(stalls) == 1
    first, second = said()[:2]  # more where this machine's own disk is slow
    assert first.startswith(str(tmp_path / "stalled/"))
    assert first.endswith("the disk has not taken it for 0.3 s; training waits for it")
    assert "training goes on" in second
    assert_same_run(tmp_path / "whole", tmp_path / "stalled")


def test_a_disk_that_answers_is_not_spoken_of(said, tmp_path: Path) -> None:
    before = threading.active_count()
    for _ in range(3):
        with warn_if_stalled(tmp_path):
            pass
    wait_until(lambda: threading.active_count() <= before)
    assert said() == []


def test_what_stalls_and_then_fails_is_said_and_fails(said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slow_disk, "STALLED_S", 0.01)

    def stall_and_fail() -> None:
        with warn_if_stalled(tmp_path):
            wait_until(said)
            raise OSError(5, "Input/output error")

    with pytest.raises(OSError, match="Input/output"):
        stall_and_fail()
    assert len(said()) == 2
