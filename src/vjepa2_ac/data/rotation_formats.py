"""Compare the formats that three rotation numbers may have: the hand turns smoothly only in the right one.

An Euler angle jumps by 2 pi where it passes pi, and a rotation vector changes its sign, although the hand turns on
evenly. Read in the right format, a jump of the numbers is an ordinary step; read in another format, the hand turns
abruptly. The speed over all steps does not show the format: in a wrong format the hand may be faster or slower.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from vjepa2_ac.config.sources import RotationFormat
from vjepa2_ac.data.poses import num_rotation_numbers, rotations_from
from vjepa2_ac.spaces import ANGLE_RAD

FORMATS: tuple[RotationFormat, ...] = ("euler_xyz", "rotation_vector", "euler_xyz_degrees")
MIN_JUMPS = 3  # at which only the other format is smooth, before the configured one is doubted

_JUMP, _JUMP_RATIO = 1.5, 6.0  # a jump: a change of the numbers above this, and above this many median changes
_STEPS_AROUND = 5  # on either side of a jump
_MIN_ANGLE_RAD = 0.005  # a smaller step counts as this one: rounding of the numbers
_SMOOTH, _ABRUPT = 3.0, 9.0  # a step's angle relative to the steps around it
_CLEAR_MAJORITY = 5


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
