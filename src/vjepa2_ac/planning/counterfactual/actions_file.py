"""A file of actions that were not taken: an array of NumPy's, or a table."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vjepa2_ac.episode import ACTION_DIM
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import POSE_CHANGE
from vjepa2_ac.storage import read_bounded

_MOST_BYTES = 1 << 20  # of a file of actions
_MOST_M, _MOST_RAD, _MOST_CLOSED = 1.0, np.pi, 1.0  # in one step: beyond are other units
_FIX = (
    "Write one line of 7 numbers, with commas, for each model step: dx, dy, dz (m), 3 angles (rad), gripper (-1 to 1)"
)


def read_actions(path: str | Path, *, steps: int | None = None) -> Float[np.ndarray, "steps 7"]:
    """Read actions of poses (legend: episode.py), one for each model step, from a `.npy` or `.csv` file.

    A CSV may begin with a line of names, dx, dy, dz, droll, dpitch, dyaw, dgripper; empty lines do not count.

    Args:
        path: The file.
        steps: How many are needed; None: any number. Further ones of the file are left out.

    Raises:
        InputError: There is no such file, it is of another kind or damaged, a row has not 7 finite numbers in metres,
            radians and closedness, or there are too few rows.
    """
    where, suffix = str(path), Path(path).suffix.lower()
    if suffix not in {".npy", ".csv"}:
        raise InputError(where=where, found=f"a file {suffix or 'without an ending'}", needed="a .npy or .csv file")
    try:
        data = read_bounded(path, _MOST_BYTES)
    except OSError as error:
        found = f"cannot be read: {error.strerror or error}"
        raise InputError(where=where, found=found, needed="a file of actions", fix=_FIX) from None
    actions = _array_in(data, where) if suffix == ".npy" else _rows_of_csv(data, where)
    if actions.ndim != 2 or actions.shape[1] != ACTION_DIM or len(actions) == 0:
        found = f"an array of shape {actions.shape}"
        raise InputError(where=where, found=found, needed=f"steps x {ACTION_DIM} numbers", fix=_FIX)
    _require_plausible(actions, where)
    if steps is not None and len(actions) < steps:
        raise InputError(where=where, found=f"{len(actions)} actions", needed=f"{steps}, one for each model step")
    return actions[:steps]


def _array_in(data: bytes, where: str) -> Float[np.ndarray, ...]:
    problem = "another kind of file"
    if data.startswith(b"\x93NUMPY"):
        try:
            array = np.load(io.BytesIO(data), allow_pickle=False)
            problem = f"values of type {array.dtype}"
            if array.dtype.kind in "fiu":
                return np.asarray(array, dtype=np.float64)
        except (ValueError, TypeError, EOFError, OverflowError, MemoryError, SyntaxError) as error:
            problem = str(error)[:200]
    raise InputError(
        where=where, found=f"not an array of numbers ({problem})", needed="what numpy.save writes", fix=_FIX
    )


def _rows_of_csv(data: bytes, where: str) -> Float[np.ndarray, "steps 7"]:
    lines = [(number, line) for number, line in enumerate(_text(data, where).splitlines(), start=1) if line.strip()]
    if lines and [word.strip() for word in lines[0][1].split(",")] == list(POSE_CHANGE.names):
        lines = lines[1:]
    rows = [_numbers(line.split(","), f"{where}: line {number}") for number, line in lines]
    return np.array(rows, dtype=np.float64).reshape(-1, ACTION_DIM)


def _text(data: bytes, where: str) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(where=where, found=f"not text ({error})", needed="lines of numbers", fix=_FIX) from None


def _numbers(words: Sequence[str], where: str) -> list[float]:
    if len(words) != ACTION_DIM:
        raise InputError(where=where, found=f"{len(words)} values", needed=f"{ACTION_DIM} numbers", fix=_FIX)
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise InputError(where=where, found=str(error), needed=f"{ACTION_DIM} numbers", fix=_FIX) from None


def _require_plausible(actions: Float[np.ndarray, "steps 7"], where: str) -> None:
    """Refuse actions that are not finite, or in other units."""
    most = np.array([_MOST_M] * 3 + [_MOST_RAD] * 3 + [_MOST_CLOSED])
    wrong = ~(np.abs(actions) <= most).all(axis=1)  # NaN is wrong, too
    if wrong.any():
        step = int(wrong.argmax())
        found = f"the numbers {np.array2string(actions[step], precision=4, max_line_width=200)}"
        needed = "finite numbers: at most 1 m and pi rad along and about each axis, closedness by 1"
        raise InputError(where=f"{where}: action {step}", found=found, needed=needed, fix=_FIX)
