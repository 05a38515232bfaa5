"""An action as short text below a frame: "right 1.1, down 0.5 cm, yaw +5°, close"; a vector as its numbers."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from vjepa2_ac.spaces import POSE_CHANGE, ActionSpace

_SMALLEST_CM = 0.05  # less is shown as no motion: it would be rounded to 0.0
_SMALLEST_DEG = 0.5
_SMALLEST_GRIP = 0.05
_WHOLE_GRIP = 0.5  # a change of closedness from which it is said without its number
_DIRECTIONS = (("back", "forward"), ("right", "left"), ("down", "up"))  # along -x and +x, -y and +y, -z and +z
_TURNS = ("roll", "pitch", "yaw")
_MOST_NUMBERS = 4


def action_text(action: Float[np.ndarray, " dim"], space: ActionSpace = POSE_CHANGE) -> str:
    """Return an action as short text: centimetres, degrees, gripper; the largest translation first.

    Directions are those of the robot base frame, seen from the robot: forward is +x, left +y, up +z. What rounds to
    zero is left out; "still" where all does. Of a vector the first numbers are shown.

    Raises:
        ValueError: The action has another width than the space.
    """
    if action.shape != (len(space),):
        raise ValueError(f"an action of shape {action.shape} in a space of {len(space)} numbers")
    if space.position is None:
        shown = " ".join(f"{number:+.2g}" for number in action[:_MOST_NUMBERS])
        return f"{shown} ..." if len(action) > _MOST_NUMBERS else shown
    parts = [_translation(100 * action[space.position])]
    if space.rotation is not None:
        degrees = np.rad2deg(action[space.rotation])
        parts += [f"{turn} {by:+.0f}°" for turn, by in zip(_TURNS, degrees, strict=True) if abs(by) >= _SMALLEST_DEG]
    if space.gripper is not None:
        parts.append(_grip(float(action[space.gripper])))
    return ", ".join(filter(None, parts)) or "still"


def _translation(by_cm: Float[np.ndarray, " 3"]) -> str:
    axes = [int(axis) for axis in np.argsort(-abs(by_cm), kind="stable") if abs(by_cm[axis]) >= _SMALLEST_CM]
    parts = [f"{_DIRECTIONS[axis][int(by_cm[axis] > 0)]} {abs(by_cm[axis]):.1f}" for axis in axes]
    return f"{', '.join(parts)} cm" if parts else ""


def _grip(change: float) -> str:
    if abs(change) < _SMALLEST_GRIP:
        return ""
    return ("open", "close")[change > 0] + ("" if abs(change) >= _WHOLE_GRIP else f" {abs(change):.1f}")
