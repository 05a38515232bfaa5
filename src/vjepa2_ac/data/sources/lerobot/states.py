"""States from the columns of a LeRobot data set: select, convert the rotation, scale the gripper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped
from scipy.spatial.transform import Rotation

from vjepa2_ac.config import LeRobotFields
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import POSE, require_finite

_UNIT_TOLERANCE = 1e-2
_FIX = "Check data.lerobot: state, select, rotation, gripper_open and gripper_closed"


def states_of(
    columns: Sequence[Shaped[np.ndarray, "steps _"]], fields: LeRobotFields, where: str
) -> Float[np.ndarray, "steps 7"]:
    """Return states (legend: `vjepa2_ac.episode`) from the concatenated columns of an episode.

    Raises:
        InputError: They are implausible under these settings: NaN, no unit quaternion, out of reach.
    """
    joined = np.concatenate([column.astype(np.float64) for column in columns], axis=1)
    if fields.select is not None:
        joined = joined[:, fields.select]
    require_finite(joined, where, fix=_FIX)
    gripper = (joined[:, -1:] - fields.gripper_open) / (fields.gripper_closed - fields.gripper_open)
    states = np.concatenate([joined[:, POSE.position], _euler(joined[:, 3:-1], fields, where), gripper], axis=1)
    POSE.require_plausible(states, where, fix=_FIX)
    return states


def vectors_of(
    columns: Sequence[Shaped[np.ndarray, "steps _"]], select: Sequence[int] | None, where: str
) -> Float[np.ndarray, "steps width"]:
    """Return the concatenated columns of an episode, all numbers or the selected ones.

    Raises:
        InputError: A number is not finite, or there are no steps.
    """
    joined = np.concatenate([column.astype(np.float64) for column in columns], axis=1)
    if select is not None:
        joined = joined[:, select]
    require_finite(joined, where, fix="Leave the episode out, or check data.lerobot: state, select and action")
    return joined


def _euler(rotation: Float[np.ndarray, "steps _"], fields: LeRobotFields, where: str) -> Float[np.ndarray, "steps 3"]:
    if fields.rotation == "euler_xyz":
        return rotation
    lengths = np.linalg.norm(rotation, axis=1)
    if (wrong := abs(lengths - 1) > _UNIT_TOLERANCE).any():
        step = int(wrong.argmax())
        raise InputError(
            where=f"{where}: step {step}",
            found=f"the quaternion {np.array2string(rotation[step], precision=4)} of length {lengths[step]:.4g}",
            needed="a unit quaternion",
            fix=_FIX,
        )
    x_first = rotation if fields.rotation == "quaternion_xyzw" else np.roll(rotation, -1, axis=1)
    return np.asarray(Rotation.from_quat(x_first).as_euler("xyz")) if len(rotation) else np.zeros((0, 3))
