"""Checkpoint selection: the newest, the best by validation, or that of a step."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import checkpoint_name, find_damage, listed, newest_checkpoint, step_of, written_state
from vjepa2_ac.runs.folder import CHECKPOINTS

NEWEST, BEST = "newest", "best"
_MOST_DIGITS = 18  # of a number of steps


@dataclass(frozen=True)
class SelectedCheckpoint:
    """A complete checkpoint, and how it was selected."""

    path: Path
    by: str  # newest, best, or a step

    def __str__(self) -> str:
        """Return its name, and whether it is the newest or the best."""
        return f"{self.path.name} ({'the ' + self.by if self.by in {NEWEST, BEST} else 'as asked for'})"


def select_checkpoint(run: Path, by: str = NEWEST) -> SelectedCheckpoint:
    """Return a complete checkpoint of a run.

    Args:
        run: The run's folder.
        by: newest; best (by validation, see `checkpoint.keep_best`); or a number of optimizer steps.

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
    if by == NEWEST:
        return SelectedCheckpoint(newest, by)
    step = _best_step(newest) if by == BEST else _number(by, folder)
    path = folder / checkpoint_name(step)
    if not path.is_dir():
        raise _not_there(folder, f"no checkpoint of step {step:,}")
    if (problem := find_damage(path)) is not None:
        raise _not_there(folder, f"{path.name} is damaged: {problem}")
    return SelectedCheckpoint(path, by)


def require_listed(run: Path, by: str = NEWEST) -> None:
    """Refuse a checkpoint that is not there, without reading any: whether it is whole is checked when it is loaded.

    Raises:
        InputError: There is no such checkpoint.
    """
    there = {str(step_of(path.name)) for path in listed(run / CHECKPOINTS)}
    if not there or (by not in {NEWEST, BEST} and by not in there):
        select_checkpoint(run, by)  # says what there is


def _best_step(newest: Path) -> int:
    step = written_state(newest).best_step
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
    return InputError(where=str(folder), found=found, needed=f"newest, best or one of the steps {steps}")
