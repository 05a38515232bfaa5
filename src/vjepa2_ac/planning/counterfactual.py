"""Counterfactual actions, which the robot did not execute: named (`up`, `close`), or read from a file.

A model can predict the outcome of such actions from any frame of recorded robot data, without a simulator.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.episode import ACTION_DIM
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.search_space import GRIPPER
from vjepa2_ac.spaces import POSE_CHANGE

STEP_M, GRIPPER_STEP = 0.05, 0.75
"""Size of a named action in one model step, in metres and in gripper position, as upstream's planning limits.
Predictions are unreliable if the training data contain only smaller motions."""

_DIRECTIONS: dict[str, tuple[int, float]] = {  # in the robot base frame: x to the front, y to the left, z up
    "up": (2, 1.0), "down": (2, -1.0),
    "left": (1, 1.0), "right": (1, -1.0),
    "forward": (0, 1.0), "back": (0, -1.0),
    "open": (6, -1.0), "close": (6, 1.0),
}  # fmt: skip
ACTION_NAMES = ("none", *_DIRECTIONS)
_MAX_ACTION = np.array([1.0] * 3 + [np.pi] * 3 + [1.0])  # metres, radians, gripper position; larger: wrong units


def make_named_actions(
    name: str, steps: int, *, size_m: float = STEP_M, limits: LimitsConfig | None = None
) -> Float[np.ndarray, "steps 7"]:
    """Return the action with a name, repeated for every model step (conventions: episode.py).

    `open` and `close` continue when the gripper is fully open or closed, as for `planning.limits.gripper_mode: close`,
    because a real gripper lags behind. Pass the result through `feasible_actions` before a model predicts from it.

    Args:
        name: One of `ACTION_NAMES`.
        steps: Number of model steps.
        size_m: Length of each step in metres; clipped to the limits.
        limits: The largest actions, ideally those in the training data (`planning.limits.xyz: data`). None: `size_m` is
            not clipped, and the gripper changes by `GRIPPER_STEP`.

    Raises:
        InputError: The name is unknown, the limits fix the component that it changes, or the length is not positive.
        ValueError: No steps.
    """
    if steps < 1:
        raise ValueError(f"{steps} steps")
    if not 0 < size_m < np.inf:
        raise InputError(where="--size", found=f"{100 * size_m:g} cm per step", needed="a length above 0 cm")
    actions = np.zeros((steps, ACTION_DIM))
    if name == "none":
        return actions
    if name not in _DIRECTIONS:
        needed = f"true (the actions of a recorded clip), {', '.join(ACTION_NAMES)}, or a file"
        raise InputError(where="actions", found=repr(name), needed=needed)
    axis, sign = _DIRECTIONS[name]
    if axis != GRIPPER:
        size = size_m if limits is None else min(size_m, limits.xyz_m[axis])
    elif limits is None:
        size = GRIPPER_STEP
    else:
        size = 0.0 if limits.gripper_mode == "held" else limits.gripper
    if size == 0:
        key, problem, needed = "gripper" if axis == GRIPPER else "xyz", "0", "a limit above 0"
        if axis == GRIPPER and limits is not None and limits.gripper_mode == "held":
            key, problem, needed = "gripper_mode", "held", "rounded or free"
        where = f"planning.limits.{key}"
        raise InputError(where=where, found=f"{problem}, so that no action can move {name}", needed=needed)
    actions[:, axis] = sign * size
    return actions


def read_actions(path: str | Path, *, steps: int | None = None) -> Float[np.ndarray, "steps 7"]:
    """Read pose actions (conventions: episode.py), one for each model step, from a `.npy` or `.csv` file.

    A CSV file may begin with a line of names; empty lines are ignored.

    Args:
        path: The file.
        steps: Number of actions to return; None: all. Additional rows of the file are ignored.

    Raises:
        InputError: The file cannot be read, a row does not have 7 finite numbers in metres, radians and gripper
            position, or there are too few rows.
    """
    needed = f"one line of {ACTION_DIM} numbers for each model step: {', '.join(POSE_CHANGE.names)}"
    fix = "Use metres, radians and gripper changes from -1 to 1, in a NumPy .npy file or a comma-separated .csv file"
    invalid_file = partial(InputError, where=str(path), needed=needed, fix=fix)
    try:
        if str(path).lower().endswith(".npy"):
            with Path(path).open("rb") as file:
                actions = np.asarray(np.lib.format.read_array(file, allow_pickle=False), dtype=np.float64)
        else:
            lines = [line for line in Path(path).read_text(encoding="utf-8-sig").splitlines() if line.strip()]
            has_header = bool(lines) and lines[0].replace(" ", "") == ",".join(POSE_CHANGE.names)
            actions = np.loadtxt(lines[has_header:], delimiter=",", ndmin=2)
    except (OSError, ValueError, TypeError) as error:
        raise invalid_file(found=f"cannot be read ({error})") from None
    if actions.ndim != 2 or actions.shape[1] != ACTION_DIM or not len(actions):
        raise invalid_file(found=f"an array of shape {actions.shape}")
    is_invalid = ~(np.abs(actions) <= _MAX_ACTION).all(axis=1)  # true for NaN as well
    if is_invalid.any():
        step = int(is_invalid.argmax())
        raise invalid_file(found=f"action {step} is {np.array2string(actions[step], precision=4, max_line_width=200)}")
    if steps is not None and len(actions) < steps:
        raise InputError(where=str(path), found=f"{len(actions)} actions", needed=f"{steps}, one for each model step")
    return actions[:steps]
