"""The opening of a run: whose its folder is, where it stands, and that no other process writes there."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import CHECKPOINTS, RunState, find_damage, listed, step_of
from vjepa2_ac.runs.folder import RunLock, check_run_folder, open_run_folder, with_settled_values
from vjepa2_ac.runs.mirror import Mirror, open_remote


@dataclass(frozen=True)
class OpenRun:
    """A run that can begin or go on, in the process that writes its files."""

    config: Config  # with the stride that the run has chosen; its run_dir has the checkpoints to resume from
    lock: RunLock
    allow_config_change: bool

    def begin(self, config: Config, state: RunState) -> None:
        """Lock the folder, and record this start in it; a new folder is only created now.

        Args:
            config: Of the run; its stride is a number.
            state: Where it begins.

        Raises:
            InputError: Another process trains in the folder, or has done so since it was inspected; or as
                `open_run_folder`.
        """
        self.lock.take()
        # Checkpoints up to its own step were inspected when the run was resumed.
        further = [path for path in listed(Path(config.run_dir, CHECKPOINTS)) if (step_of(path.name) or 0) > state.step]
        newest = next((path for path in reversed(further) if find_damage(path) is None), None)
        if newest is not None:
            there = f"a checkpoint of step {step_of(newest.name)}"
            found = f"{there}, which another start wrote while this one stood at {state.step}"
            raise InputError(where=str(newest), found=found, fix="Start again: the run continues from there")
        open_run_folder(config, state.run_id, allow_config_change=self.allow_config_change)

    def mirror(self, run_id: str) -> Mirror | None:
        """Return what keeps `checkpoint.remote` up to date."""
        place = self.config.checkpoint.remote
        return None if place is None else Mirror(place, self.config, run_id)


@contextlib.contextmanager
def open_run(
    config: Config, reporter: Reporter, *, check_only: bool = False, allow_config_change: bool = False
) -> Iterator[OpenRun]:
    """Check the folder of a run, fetch what is newer in `checkpoint.remote`, and hold the lock to the end of the block.

    Args:
        config: The run.
        reporter: Receives messages.
        check_only: Lock nothing, and download into a temporary folder.
        allow_config_change: The run in the folder may have another config.

    Raises:
        InputError: The folder is not this run's, is in use or cannot be written; or as `open_remote`.
    """
    config, trial = with_settled_values(config), None
    check_run_folder(config, allow_config_change=allow_config_change)
    with contextlib.ExitStack() as until_the_end:
        lock = until_the_end.enter_context(RunLock(Path(config.run_dir)))
        if check_only:
            trial = Path(until_the_end.enter_context(tempfile.TemporaryDirectory()), "run")
        elif Path(config.run_dir).is_dir():  # a new one is created, and locked, after all checks
            lock.take()
        # Locked before anything is downloaded into the run's folder: another process could still be writing there.
        first = None if check_only else lock
        config = open_remote(config, reporter, lock=first, allow_config_change=allow_config_change, into=trial)
        yield OpenRun(with_settled_values(config), lock, allow_config_change)
