"""Poses as data sets write them, converted to the project's states (conventions: `vjepa2_ac.episode`).

And the formats that three rotation numbers may have, compared: the hand turns smoothly only in the right one. An Euler
angle jumps by 2 pi where it passes pi, and a rotation vector changes its sign, although the hand turns on evenly. Read
in the right format, a jump of the numbers is an ordinary step; read in another format, the hand turns abruptly. The
speed over all steps does not show the format: in a wrong format the hand may be faster or slower.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from vjepa2_ac.config.data import PoseFields, RotationFormat
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import ANGLE_RAD, POSE

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_UNIT_TOLERANCE = 1e-2

FORMATS: tuple[RotationFormat, ...] = ("euler_xyz", "rotation_vector", "euler_xyz_degrees")
MIN_JUMPS = 3  # at which only the other format is smooth, before the configured one is doubted

_JUMP, _JUMP_RATIO = 1.5, 6.0  # a jump: a change of the numbers above this, and above this many median changes
_STEPS_AROUND = 5  # on either side of a jump
_MIN_ANGLE_RAD = 0.005  # a smaller step counts as this one: rounding of the numbers
_SMOOTH, _ABRUPT = 3.0, 9.0  # a step's angle relative to the steps around it
_CLEAR_MAJORITY = 5


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
        raise InputError(where=f"{where}: step {step}", found=found, needed="a unit quaternion", fix=fix)


# ---- formats of rotations ----


@dataclass(frozen=True, eq=False)
class RotationSpeeds:
    """How fast a hand turns if the rotation numbers of some episodes have one format."""

    median_rad_s: float  # over the steps at which the numbers change; 0 if they never do
    at_jumps: Float[np.ndarray, " jumps"]  # the speed at each jump of the numbers, relative to the steps around it

    @property
    def num_jumps(self) -> int:
        """The number of jumps of the numbers."""
        return len(self.at_jumps)

    @property
    def num_smooth_jumps(self) -> int:
        """The number of jumps at which the hand turns about as fast as around them, as in the right format."""
        return int((self.at_jumps <= _SMOOTH).sum())

    def num_smoother_than(self, other: RotationSpeeds) -> int:
        """Return the number of jumps at which the hand turns smoothly in this format and abruptly in the other."""
        return int(((self.at_jumps <= _SMOOTH) & (other.at_jumps >= _ABRUPT)).sum())


def rotation_speeds(
    episodes: Iterable[Float[np.ndarray, "steps 3"]], control_rate_hz: float
) -> dict[RotationFormat, RotationSpeeds]:
    """Return how fast the hand turns in each format that the rotation numbers may have.

    Quaternions are not compared: with w first or last they give the same speeds.

    Args:
        episodes: The three rotation numbers of each control step, as the data set has them.
        control_rate_hz: Control steps per second.

    Returns:
        By format; those in radians only if no number is too large for radians.
    """
    numbers = [_without_repetitions(one) for one in episodes]
    numbers = [one for one in numbers if len(one) > 1]
    largest = max((float(abs(one).max()) for one in numbers), default=0.0)
    jumps = [_jumps_in(one) for one in numbers]
    speeds: dict[RotationFormat, RotationSpeeds] = {}
    for written_as in FORMATS:
        if written_as != "euler_xyz_degrees" and largest > ANGLE_RAD:
            continue
        angles = [_step_angles(one, written_as) for one in numbers]
        ratios = [_relative_to_neighbours(one, at) for one, at in zip(angles, jumps, strict=True)]
        median = float(np.median(np.concatenate(angles))) * control_rate_hz if angles else 0.0
        speeds[written_as] = RotationSpeeds(median, np.concatenate([np.zeros(0), *ratios]))
    return speeds


def smoother_format(
    speeds: Mapping[RotationFormat, RotationSpeeds], written_as: RotationFormat, max_rad_s: float
) -> RotationFormat | None:
    """Return the format in which the hand turns much more smoothly than in the configured one; None: there is none.

    tests/data/test_rotation_formats.py tries random smooth motions in all three formats. A hand that points down (roll
    near pi) usually makes the numbers jump. If the hand is tilted by more than it moves, or is near its zero rotation,
    the numbers never jump, and a wrong format is not found. Numbers in degrees are found if one of them is too large
    for radians.

    Args:
        speeds: What `rotation_speeds` returns.
        written_as: The configured format.
        max_rad_s: A median speed above this one is impossible: the numbers are degrees.
    """
    if num_rotation_numbers(written_as) == 4:
        return None
    configured = speeds.get(written_as)
    if configured is None or configured.median_rad_s > max_rad_s:
        return "euler_xyz_degrees" if written_as != "euler_xyz_degrees" else None
    gains = {other: one.num_smoother_than(configured) for other, one in speeds.items()}
    clear = [
        other
        for other, gain in gains.items()
        if gain >= MIN_JUMPS and gain > _CLEAR_MAJORITY * configured.num_smoother_than(speeds[other])
    ]
    return max(clear, key=lambda other: gains[other], default=None)


def _without_repetitions(numbers: Float[np.ndarray, "steps 3"]) -> Float[np.ndarray, "changing 3"]:
    """Return the steps without those that repeat the previous one, which hide the speed."""
    return numbers[np.append(np.diff(numbers, axis=0).any(axis=1), True)] if len(numbers) else numbers


def _jumps_in(numbers: Float[np.ndarray, "steps 3"]) -> Bool[np.ndarray, " changes"]:
    change = np.linalg.norm(np.diff(numbers, axis=0), axis=1)
    return np.asarray(change > max(_JUMP, _JUMP_RATIO * float(np.median(change))))


def _step_angles(numbers: Float[np.ndarray, "steps 3"], written_as: RotationFormat) -> Float[np.ndarray, " changes"]:
    rotations = rotations_from(numbers, written_as)
    return np.asarray((rotations[1:] * rotations[:-1].inv()).magnitude())


def _relative_to_neighbours(
    angles: Float[np.ndarray, " changes"], is_jump: Bool[np.ndarray, " changes"]
) -> Float[np.ndarray, " jumps"]:
    """Return the angle at each jump, relative to the mean of the steps around it without jumps; NaN: there are none."""
    calm = np.stack([np.where(is_jump, 0.0, angles), ~is_jump])
    sums = np.cumsum(np.pad(calm, ((0, 0), (_STEPS_AROUND + 1, _STEPS_AROUND))), axis=1)
    total, count = (sums[:, 2 * _STEPS_AROUND + 1 :] - sums[:, : -2 * _STEPS_AROUND - 1])[:, is_jump]
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return np.asarray(angles[is_jump] / np.maximum(mean, _MIN_ANGLE_RAD))
