"""A run that is killed repeatedly, at any time, equals an uninterrupted run.

Three kills by default. Before a release, VJEPA2_AC_SOAK=20 sets the number of kills for each kind of run.
"""

import logging
import os
import time
from pathlib import Path

import numpy as np
import pytest

from killable import KILLED, Child, ForkServer, wait_for_the_end_of
from same_run import assert_same_run
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.training.loop import train

logger = logging.getLogger(__name__)

SOAK_KILLS = int(os.environ.get("VJEPA2_AC_SOAK", "0"))
MODES = ("before a file", "while writing", "random time")
CHANGES = {
    "training__steps": 24, "validation__every": 4, "checkpoint__every": 2, "checkpoint__keep": 2,
}  # fmt: skip


class Killer:
    """Starts and kills runs in three modes, one after the other, and counts the kills."""

    def __init__(self, fork_server: ForkServer, seed: int) -> None:
        self.kills, self.in_a_checkpoint, self.processes = 0, 0, set()
        self._fork_server, self._rng = fork_server, np.random.default_rng(seed)

    def kill(self, config_file: Path, run: Path) -> int:
        """Start or resume a run and kill it; return its exit status, which is 0 if it finished first."""
        before = half_written(run)
        child, wait = self._start(MODES[self.kills % len(MODES)], config_file, run)
        self.processes.add(child.pid)
        status = wait()
        if status == KILLED:
            self.kills += 1
            self.in_a_checkpoint += bool(half_written(run) - before)
        return status

    def _start(self, mode: str, config_file: Path, run: Path):
        rng, arguments = self._rng, ("train", str(config_file))
        if mode == "before a file":  # a checkpoint has about 25 file operations
            child = self._fork_server.start(*arguments, folder=run, die_at=int(rng.integers(1, 120)))
            return child, child.wait
        child = self._fork_server.start(*arguments, folder=run)
        if mode == "while writing":
            wait_for_writing(child, run / "checkpoints", times=int(rng.integers(1, 4)))
            return child, lambda: child.kill_after(rng.uniform(0.0, 0.01))  # about the duration of a write
        return child, lambda: child.kill_after(rng.uniform(0.0, 2.0))


def half_written(run: Path) -> set[tuple[str, int]]:
    """Return the incomplete checkpoints, each with the time of its last change."""
    return {(path.name, path.stat().st_ctime_ns) for path in (run / "checkpoints").glob(".writing-*")}


def wait_for_writing(child: Child, checkpoints: Path, times: int) -> None:
    """Wait until a run has begun to write `times` checkpoints, or has ended."""
    names: set[str] = set()
    while len(names) < times and child.is_running():
        names |= {path.name for path in checkpoints.glob(".writing-*")}
        time.sleep(0.0005)


@pytest.mark.parametrize("keep_best", ["off", "error"] if SOAK_KILLS else ["error"])
@pytest.mark.parametrize("workers", [0, 2] if SOAK_KILLS else [0])
def test_run_killed_many_times_equals_an_uninterrupted_run(
    make_config, reporter, tmp_path, fork_server: ForkServer, workers: int, keep_best: str
) -> None:
    changes = {**CHANGES, "checkpoint__keep_best": keep_best}
    train(make_config(run_dir=str(tmp_path / "whole"), **changes), reporter)
    killer, runs, num_kills = (
        Killer(fork_server, seed=2 * workers + (keep_best == "error")),
        0,
        SOAK_KILLS or len(MODES),
    )
    while killer.kills < num_kills:
        runs += 1
        run, config_file = tmp_path / f"killed-{runs}", tmp_path / f"{runs}.yaml"
        config_file.write_text(config_as_yaml(make_config(run_dir=str(run), data__workers=workers, **changes)))
        status = KILLED
        while status == KILLED and killer.kills < num_kills:
            status = killer.kill(config_file, run)
        if status == KILLED:
            status = fork_server.start("train", str(config_file), folder=run).wait()
        assert status == 0
        assert_same_run(tmp_path / "whole", run)
    assert not wait_for_the_end_of(killer.processes, timeout_s=120), "a worker outlived its run"
    logger.info(
        "%d workers, keep_best %s: %d kills in %d runs, %d of them in the middle of a checkpoint",
        workers, keep_best, killer.kills, runs, killer.in_a_checkpoint,
    )  # fmt: skip
