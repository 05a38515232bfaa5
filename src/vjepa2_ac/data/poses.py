"""Convert poses from the formats of data sets to states, and detect a wrong rotation format.

The conventions of states are in `vjepa2_ac.episode`. A wrong format of three rotation numbers is detected at jumps: an
Euler angle jumps by 2 pi where it passes pi, and a rotation vector changes its sign, although the hand turns smoothly.
In the right format, the rotation at a jump of the numbers is as small as at other steps; in another format the hand
seems to turn abruptly. The mean speed does not show the format, because a wrong format may make the hand faster or
slower.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from vjepa2_ac.config.data import PoseFields, RotationFormat
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.spaces import MAX_ANGLE_RAD, POSE

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_UNIT_TOLERANCE = 1e-2

FORMATS: tuple[RotationFormat, ...] = ("euler_xyz", "rotation_vector", "euler_xyz_degrees")
MIN_JUMPS = 3  # jumps at which only another format is smooth, required to reject the configured format

_JUMP, _JUMP_RATIO = 1.5, 6.0  # a jump exceeds this change of the numbers and this multiple of the median change
_STEPS_AROUND = 5  # steps on either side of a jump
_MIN_ANGLE_RAD = 0.005  # lower bound of a step's angle, because smaller angles are rounding errors
_SMOOTH, _ABRUPT = 3.0, 9.0  # limits of a step's angle relative to the steps around it
_CLEAR_MAJORITY = 5  # smallest ratio of jumps that favour another format to jumps that favour the configured one


def num_rotation_numbers(rotation_format: RotationFormat) -> int:
    """Return how many numbers describe a rotation: 4 for quaternions, 3 in the other formats."""
    return 4 if rotation_format.startswith("quaternion") else 3


def convert_rotations(numbers: Float[np.ndarray, "steps _"], rotation_format: RotationFormat) -> Rotation:
    """Convert rotations from the numbers of a format to SciPy rotations.

    Raises:
        ValueError: A quaternion is zero.
    """
    if rotation_format == "quaternion_xyzw":
        return Rotation.from_quat(numbers)
    if rotation_format == "quaternion_wxyz":
        return Rotation.from_quat(np.roll(numbers, -1, axis=1))
    if rotation_format == "rotation_vector":
        return Rotation.from_rotvec(numbers)
    return Rotation.from_euler("xyz", numbers, degrees=rotation_format == "euler_xyz_degrees")


def convert_poses(
    numbers: Float[np.ndarray, "steps _"], fields: PoseFields, where: str, *, section: str
) -> Float[np.ndarray, "steps 7"]:
    """Convert the numbers of an episode (position, rotation and gripper of each step) to states.

    Args:
        numbers: The selected numbers, in the order position, rotation, gripper.
        fields: The format of the numbers.
        where: File and episode, for messages.
        section: The config section of the fields, such as data.lerobot.

    Raises:
        InputError: The poses are implausible in this format, such as positions out of reach or quaternions of other
                lengths than 1.
    """
    fix = f"Check {section}: state, select, rotation, position_unit, gripper_open and gripper_closed"
    require_plausible = partial(
        POSE.require_plausible, where=where, fix=fix, conversions=_get_unit_fixes(fields, section)
    )
    positions, rotation = numbers[:, :3] * _METRES[fields.position_unit], numbers[:, 3:-1]
    gripper = (numbers[:, -1:] - fields.gripper_open) / (fields.gripper_closed - fields.gripper_open)
    if num_rotation_numbers(fields.rotation) == 4:
        _require_unit_quaternions(rotation, where, fix)
    elif fields.rotation != "euler_xyz":
        unit = np.pi / 180 if fields.rotation == "euler_xyz_degrees" else 1.0
        require_plausible(np.concatenate([positions, unit * rotation, gripper], axis=1))
    if fields.rotation != "euler_xyz":
        rotation = convert_rotations(rotation, fields.rotation).as_euler("xyz")
    states = np.concatenate([positions, rotation, gripper], axis=1)
    require_plausible(states)
    return states


def _get_unit_fixes(fields: PoseFields, section: str) -> dict[str, str]:
    """Return how to configure other units, by the name of the unit that the numbers seem to have."""
    conversions = {}
    if fields.position_unit == "m":
        conversions = {unit: f"set {section}.position_unit: {unit[0]}m" for unit in ("millimetres", "centimetres")}
    if fields.rotation == "euler_xyz":
        conversions["degrees"] = f"set {section}.rotation: euler_xyz_degrees"
    return conversions


def require_selection(
    columns: Mapping[str, int], fields: PoseFields, section: str, *, is_pose: bool, episode: str = ""
) -> None:
    """Refuse a `select` with indices out of range, or numbers that do not form a pose.

    Args:
        columns: The width of each column of `state`, by its description.
        fields: `select` and `rotation`.
        section: The config section of the fields, such as data.lerobot.
        is_pose: Whether `data.states` is pose.
        episode: File and episode, for messages; empty: all episodes have these columns.

    Raises:
        InputError: Names the config key to change.
    """
    section_path = f"{episode}: {section}" if episode else section
    source, where = " + ".join(columns), f"{section_path}.state"
    count = width = sum(columns.values())
    if fields.select is not None:
        where, count = f"{section_path}.select", len(fields.select)
        if invalid_indices := [number for number in fields.select if number >= width]:
            problem = f"index {invalid_indices[0]}, but {source} has {counted(width, 'number')}"
            raise InputError(where=where, found=problem, needed=f"indices from 0 to {width - 1}")
    rotation_width = num_rotation_numbers(fields.rotation)
    if is_pose and count != 4 + rotation_width:
        kind = "a quaternion's 4 numbers" if rotation_width == 4 else "3 numbers of the rotation"
        needed = (
            f"{4 + rotation_width} numbers: x, y, z, {kind} ({section}.rotation: {fields.rotation}) and the gripper"
        )
        fix = f"Set other columns in {section}.state, or select some of their numbers with {section}.select"
        raise InputError(where=where, found=f"{count} numbers per step from {source}", needed=needed, fix=fix)


def _require_unit_quaternions(quaternions: Float[np.ndarray, "steps 4"], where: str, fix: str) -> None:
    lengths = np.linalg.norm(quaternions, axis=1)
    is_wrong = ~(abs(lengths - 1) <= _UNIT_TOLERANCE)  # also true for NaN
    if is_wrong.any():
        step = int(is_wrong.argmax())
        problem = f"the quaternion {np.array2string(quaternions[step], precision=4)} of length {lengths[step]:.4g}"
        raise InputError(where=f"{where}: step {step}", found=problem, needed="a unit quaternion", fix=fix)


# ---- formats of rotations ----


@dataclass(frozen=True, eq=False)
class RotationSpeeds:
    """The rotation speed of the hand if the rotation numbers of some episodes are read in one format."""

    median_rad_s: float  # over the steps at which the numbers change; 0 if they never change
    at_jumps: Float[np.ndarray, " jumps"]  # the speed at each jump of the numbers, relative to the steps around it

    @property
    def num_jumps(self) -> int:
        """The number of jumps of the numbers."""
        return len(self.at_jumps)

    @property
    def num_smooth_jumps(self) -> int:
        """The number of jumps at which the hand turns about as fast as at the steps around, as in the right format."""
        return int((self.at_jumps <= _SMOOTH).sum())

    def num_smoother_than(self, other: RotationSpeeds) -> int:
        """Return the number of jumps at which the hand turns smoothly in this format and abruptly in the other."""
        return int(((self.at_jumps <= _SMOOTH) & (other.at_jumps >= _ABRUPT)).sum())


def measure_rotation_speeds(
    episodes: Iterable[Float[np.ndarray, "steps 3"]], control_rate_hz: float
) -> dict[RotationFormat, RotationSpeeds]:
    """Return the rotation speeds of the hand in each format that three rotation numbers may have.

    The two orders of quaternions are not compared, because they give the same speeds.

    Args:
        episodes: The three rotation numbers of each control step, as stored in the data set.
        control_rate_hz: Control steps per second.

    Returns:
        Speeds by format. Formats in radians are absent if a number is too large for radians.
    """
    numbers = [_remove_repetitions(episode) for episode in episodes]
    numbers = [episode for episode in numbers if len(episode) > 1]
    largest = max((float(abs(episode).max()) for episode in numbers), default=0.0)
    jumps = [_find_jumps(episode) for episode in numbers]
    speeds: dict[RotationFormat, RotationSpeeds] = {}
    for rotation_format in FORMATS:
        if rotation_format != "euler_xyz_degrees" and largest > MAX_ANGLE_RAD:
            continue
        angles = [_compute_step_angles(episode, rotation_format) for episode in numbers]
        ratios = [
            _compare_with_neighbours(episode_angles, is_jump)
            for episode_angles, is_jump in zip(angles, jumps, strict=True)
        ]
        median = float(np.median(np.concatenate(angles))) * control_rate_hz if angles else 0.0
        speeds[rotation_format] = RotationSpeeds(median, np.concatenate([np.zeros(0), *ratios]))
    return speeds


def find_smoother_format(
    speeds: Mapping[RotationFormat, RotationSpeeds], rotation_format: RotationFormat, max_rad_s: float
) -> RotationFormat | None:
    """Return the format in which the hand turns much more smoothly than in the configured one, or None.

    A wrong format is only detected if the numbers jump, or if numbers in degrees are too large for radians. Numbers
    usually jump if the hand points down (roll near pi). They do not jump if no angle passes pi, for example near the
    zero rotation. tests/data/test_rotation_formats.py tests random smooth motions in all three formats.

    Args:
        speeds: The result of `measure_rotation_speeds`.
        rotation_format: The configured format.
        max_rad_s: The largest possible median speed; if it is exceeded, the numbers are degrees.
    """
    if num_rotation_numbers(rotation_format) == 4:
        return None
    configured = speeds.get(rotation_format)
    if configured is None or configured.median_rad_s > max_rad_s:
        return "euler_xyz_degrees" if rotation_format != "euler_xyz_degrees" else None
    num_smoother = {other: other_speeds.num_smoother_than(configured) for other, other_speeds in speeds.items()}
    candidates = [
        other
        for other, count in num_smoother.items()
        if count >= MIN_JUMPS and count > _CLEAR_MAJORITY * configured.num_smoother_than(speeds[other])
    ]
    return max(candidates, key=lambda other: num_smoother[other], default=None)


def _remove_repetitions(numbers: Float[np.ndarray, "steps 3"]) -> Float[np.ndarray, "changing 3"]:
    """Remove steps whose numbers equal those of the next step, because repetitions distort the speed."""
    return numbers[np.append(np.diff(numbers, axis=0).any(axis=1), True)] if len(numbers) else numbers


def _find_jumps(numbers: Float[np.ndarray, "steps 3"]) -> Bool[np.ndarray, " changes"]:
    change = np.linalg.norm(np.diff(numbers, axis=0), axis=1)
    return np.asarray(change > max(_JUMP, _JUMP_RATIO * float(np.median(change))))


def _compute_step_angles(
    numbers: Float[np.ndarray, "steps 3"], rotation_format: RotationFormat
) -> Float[np.ndarray, " changes"]:
    rotations = convert_rotations(numbers, rotation_format)
    return np.asarray((rotations[1:] * rotations[:-1].inv()).magnitude())


def _compare_with_neighbours(
    angles: Float[np.ndarray, " changes"], is_jump: Bool[np.ndarray, " changes"]
) -> Float[np.ndarray, " jumps"]:
    """Return the angle at each jump relative to the mean angle of nearby steps without a jump; NaN if all jump."""
    angles_and_counts = np.stack([np.where(is_jump, 0.0, angles), ~is_jump])
    sums = np.cumsum(np.pad(angles_and_counts, ((0, 0), (_STEPS_AROUND + 1, _STEPS_AROUND))), axis=1)
    total, count = (sums[:, 2 * _STEPS_AROUND + 1 :] - sums[:, : -2 * _STEPS_AROUND - 1])[:, is_jump]
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return np.asarray(angles[is_jump] / np.maximum(mean, _MIN_ANGLE_RAD))
