"""Checkpoint selection: the best by validation, the newest, or that of a step."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import (
    RunState,
    checkpoint_name,
    find_damage,
    listed,
    newest_checkpoint,
    step_of,
    written_state,
)
from vjepa2_ac.runs.folder import CHECKPOINTS

SELECTED, NEWEST, BEST = "selected", "newest", "best"
_MOST_DIGITS = 18  # of a number of steps


@dataclass(frozen=True)
class SelectedCheckpoint:
    """A complete checkpoint, and how it was selected."""

    path: Path
    why: str  # how it was selected, in words

    def __str__(self) -> str:
        """Return its name, and how it was selected."""
        return f"{self.path.name} ({self.why})"


def select_checkpoint(run: Path, by: str = SELECTED) -> SelectedCheckpoint:
    """Return a complete checkpoint of a run.

    Args:
        run: The run's folder.
        by: selected: the best where there is one, else the newest; newest; best (by validation, see
            `checkpoint.keep_best`); or a number of optimizer steps.

    Raises:
        InputError: There is no such checkpoint, or it is damaged; names the existing ones.
    """
    folder = run / CHECKPOINTS
    newest = newest_checkpoint(folder)
    if newest is None:
        raise InputError(
            where=str(run),
            found="a run without a whole checkpoint",
            needed="at least one",
            fix=f"Train on with `vjepa2-ac train {run} --resume`",
        )
    state = written_state(newest)
    if by == NEWEST or (by == SELECTED and state.best_step is None):
        return SelectedCheckpoint(newest, "the newest" if by == NEWEST else "the newest: none was selected")
    step = _best_step(newest, state) if by in {SELECTED, BEST} else _number(by, folder)
    path = folder / checkpoint_name(step)
    if not path.is_dir():
        raise _not_there(folder, f"no checkpoint of step {step:,}")
    if (problem := find_damage(path)) is not None:
        raise _not_there(folder, f"{path.name} is damaged: {problem}")
    return SelectedCheckpoint(path, _why(state, step) if by in {SELECTED, BEST} else "as asked for")


def require_listed(run: Path, by: str = SELECTED) -> None:
    """Refuse a checkpoint that is not there, without reading any: whether it is whole is checked when it is loaded.

    Raises:
        InputError: There is no such checkpoint.
    """
    there = {str(step_of(path.name)) for path in listed(run / CHECKPOINTS)}
    if not there or (by not in {SELECTED, NEWEST, BEST} and by not in there):
        select_checkpoint(run, by)  # says what there is


def _why(state: RunState, step: int) -> str:
    by = "error" if state.best_rank is None else "action ranking"
    return f"the best by {by}" if step else f"the base: none of its checkpoints is better by {by}"


def _best_step(newest: Path, state: RunState) -> int:
    step = state.best_step
    if step is None:
        found = (
            "no best checkpoint: checkpoint.keep_best was off, there was no validation yet, what it measures was"
            " changed since, or it was deleted"
        )
        raise _not_there(newest.parent, found)
    return step


def _number(by: str, folder: Path) -> int:
    if not by.isdecimal() or len(by) > _MOST_DIGITS:
        raise _not_there(folder, f"--checkpoint {by}")
    return int(by)


def _not_there(folder: Path, found: str) -> InputError:
    steps = ", ".join(str(step_of(path.name)) for path in listed(folder) if find_damage(path) is None)
    return InputError(where=str(folder), found=found, needed=f"selected, newest, best or one of the steps {steps}")
