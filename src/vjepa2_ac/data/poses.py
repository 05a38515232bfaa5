"""Poses as data sets write them, converted to the project's states (conventions: `vjepa2_ac.episode`)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vjepa2_ac.config.sources import PoseFields, RotationFormat
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import POSE

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_UNIT_TOLERANCE = 1e-2


def num_rotation_numbers(written_as: RotationFormat) -> int:
    """Return how many numbers a rotation has: 4 for a quaternion, 3 for the other formats."""
    return 4 if written_as.startswith("quaternion") else 3


def rotations_from(numbers: Float[np.ndarray, "steps _"], written_as: RotationFormat) -> Rotation:
    """Return the rotations that these numbers describe.

    Raises:
        ValueError: A quaternion is zero.
    """
    if written_as == "quaternion_xyzw":
        return Rotation.from_quat(numbers)
    if written_as == "quaternion_wxyz":
        return Rotation.from_quat(np.roll(numbers, -1, axis=1))
    if written_as == "rotation_vector":
        return Rotation.from_rotvec(numbers)
    return Rotation.from_euler("xyz", numbers, degrees=written_as == "euler_xyz_degrees")


def poses_from(
    numbers: Float[np.ndarray, "steps _"], fields: PoseFields, where: str, *, section: str
) -> Float[np.ndarray, "steps 7"]:
    """Return states from the numbers of an episode: position, rotation and gripper of each step.

    Args:
        numbers: The selected numbers, in the order position, rotation, gripper.
        fields: Their format.
        where: File and episode, for messages.
        section: The config section of the fields, such as data.lerobot.

    Raises:
        InputError: They are implausible under these settings: not a unit quaternion, out of reach.
    """
    fix = f"Check {section}: state, select, rotation, position_unit, gripper_open and gripper_closed"
    require_plausible = partial(POSE.require_plausible, where=where, fix=fix, conversions=_conversions(fields, section))
    positions, rotation = numbers[:, :3] * _METRES[fields.position_unit], numbers[:, 3:-1]
    gripper = (numbers[:, -1:] - fields.gripper_open) / (fields.gripper_closed - fields.gripper_open)
    if num_rotation_numbers(fields.rotation) == 4:
        _require_unit_quaternions(rotation, where, fix)
    elif fields.rotation != "euler_xyz":
        unit = np.pi / 180 if fields.rotation == "euler_xyz_degrees" else 1.0
        require_plausible(np.concatenate([positions, unit * rotation, gripper], axis=1))
    if fields.rotation != "euler_xyz":
        rotation = rotations_from(rotation, fields.rotation).as_euler("xyz")
    states = np.concatenate([positions, rotation, gripper], axis=1)
    require_plausible(states)
    return states


def _conversions(fields: PoseFields, section: str) -> dict[str, str]:
    """Return, by the name of a unit that implausible numbers may look like, the config key to set."""
    conversions = {}
    if fields.position_unit == "m":
        conversions = {unit: f"set {section}.position_unit: {unit[0]}m" for unit in ("millimetres", "centimetres")}
    if fields.rotation == "euler_xyz":
        conversions["degrees"] = f"set {section}.rotation: euler_xyz_degrees"
    return conversions


def require_selection(
    columns: Mapping[str, int], fields: PoseFields, section: str, *, is_pose: bool, episode: str = ""
) -> None:
    """Refuse `select` beyond the numbers that there are, and numbers that do not form a pose.

    Args:
        columns: The width of each column of `state`, by its description.
        fields: `select` and `rotation`.
        section: The config section of the fields, such as data.lerobot.
        is_pose: Whether `data.states` is pose.
        episode: File and episode, for messages; empty: all episodes have these columns.

    Raises:
        InputError: Says what was found and which key to change.
    """
    place = f"{episode}: {section}" if episode else section
    source, where = " + ".join(columns), f"{place}.state"
    count = width = sum(columns.values())
    if fields.select is not None:
        where, count = f"{place}.select", len(fields.select)
        if beyond := [number for number in fields.select if number >= width]:
            found = f"{beyond[0]}, of {width} numbers in {source}"
            raise InputError(where=where, found=found, needed=f"0 to {width - 1}")
    rotation_width = num_rotation_numbers(fields.rotation)
    if is_pose and count != 4 + rotation_width:
        kind = "a quaternion's 4 numbers" if rotation_width == 4 else "3 numbers of the rotation"
        needed = f"{4 + rotation_width}: x, y, z, {kind} ({section}.rotation: {fields.rotation}), the gripper"
        fix = f"Name other columns in {section}.state, or choose among their numbers with {section}.select"
        raise InputError(where=where, found=f"{count} numbers a step from {source}", needed=needed, fix=fix)


def _require_unit_quaternions(quaternions: Float[np.ndarray, "steps 4"], where: str, fix: str) -> None:
    lengths = np.linalg.norm(quaternions, axis=1)
    is_wrong = ~(abs(lengths - 1) <= _UNIT_TOLERANCE)  # NaN is wrong, too
    if is_wrong.any():
        step = int(is_wrong.argmax())
        found = f"the quaternion {np.array2string(quaternions[step], precision=4)} of length {lengths[step]:.4g}"
        if not np.any(quaternions[step]):
            found += " (an empty measurement, as before the first message of a sensor)"
        raise InputError(where=f"{where}: step {step}", found=found, needed="a unit quaternion", fix=fix)
