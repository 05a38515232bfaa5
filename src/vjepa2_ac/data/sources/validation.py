"""Validation of robot states: the check that every source runs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from vjepa2_ac.errors import InputError

_REACH_LIMIT_M = 5.0
_ANGLE_LIMIT_RAD = 2 * np.pi + 0.1
_GRIPPER_TOLERANCE = 0.05


def require_plausible(states: Float[np.ndarray, "steps 7"], where: str, *, fix: str) -> None:
    """Refuse implausible metres, radians and closedness (legend: `vjepa2_ac.episode`), and an episode without steps.

    Args:
        states: Measured states of every control step.
        where: File and episode, for messages.
        fix: Which settings to check.

    Raises:
        InputError: Names the first implausible step, and its numbers.
    """
    if len(states) == 0:
        raise zero_steps(where)
    gripper = (states[:, 6] < -_GRIPPER_TOLERANCE) | (states[:, 6] > 1 + _GRIPPER_TOLERANCE)
    checks = (
        (~np.isfinite(states).all(axis=1), "finite numbers"),
        (
            abs(states[:, :3]).max(axis=1) > _REACH_LIMIT_M,
            f"a position within {_REACH_LIMIT_M:g} m of the base, in metres",
        ),
        (abs(states[:, 3:6]).max(axis=1) > _ANGLE_LIMIT_RAD, "Euler angles in radians"),
        (gripper, "a gripper between 0 and 1"),
    )
    for wrong, needed in checks:
        if wrong.any():
            step = int(wrong.argmax())
            raise InputError(
                where=f"{where}: step {step}",
                found=f"the state {np.array2string(states[step], precision=4, max_line_width=200)}",
                needed=needed,
                fix=fix,
            )


def require_finite(states: Float[np.ndarray, "steps state_dim"], where: str, *, fix: str) -> None:
    """Refuse impossible state or command vectors, and an episode without steps. Their meaning is unknown.

    Raises:
        InputError: Names the first step with a number that is not finite.
    """
    if len(states) == 0:
        raise zero_steps(where)
    if (wrong := ~np.isfinite(states).all(axis=1)).any():
        step = int(wrong.argmax())
        raise InputError(
            where=f"{where}: step {step}",
            found=f"the numbers {np.array2string(states[step], precision=4, max_line_width=200)}",
            needed="finite numbers",
            fix=fix,
        )


def zero_steps(where: str) -> InputError:
    """Return the error of an episode without steps."""
    return InputError(where=where, found="no steps", needed="one or more")
