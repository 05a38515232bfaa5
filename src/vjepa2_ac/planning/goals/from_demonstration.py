"""Key frames of a demonstration as goals: how long each may take, and what the gripper does on the way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from vjepa2_ac.planning.goals.key_frames import GRIPPER, GRIPS, KeyFrame
from vjepa2_ac.planning.goals.sub_goals import GripperMode, SubGoal


@dataclass(frozen=True)
class Timing:
    """How long goals of a demonstration apply."""

    stride: int = 1  # frames of a model step
    slack: int = 3  # model steps that a goal may take fewer or more than the demonstration
    share: float | None = None  # of each goal but the last

    def steps(self, begin: int, end: int) -> int:
        """Return the model steps from one frame to another, 1 at least."""
        return max(1, math.ceil((end - begin) / self.stride))


def sub_goals_of(
    images: Sequence[np.ndarray],
    keys: Sequence[KeyFrame],
    timing: Timing,
    states: Float[np.ndarray, "frames 7"] | None = None,
) -> tuple[SubGoal, ...]:
    """Return key frames as goals, with the demonstration's durations and, if states are known, gripper modes.

    On the way to a frame at which the gripper is more closed than at the one before, it closes; likewise it opens; else
    it is held.

    Args:
        images: Of the key frames.
        keys: Which they are.
        timing: How long they may take.
        states: Of all frames of the demonstration; None: the gripper does what planning.limits say.
    """
    goals, before = [], 0
    for image, key in zip(images, keys, strict=True):
        steps = timing.steps(before, key.frame)
        gripper = None if states is None else _gripper_mode(states[before], states[key.frame])
        low, high = max(1, steps - timing.slack), steps + timing.slack
        goals.append(SubGoal(image, key.name, low, high, timing.share, gripper))
        before = key.frame
    return (*goals[:-1], replace(goals[-1], at_most=None, share=None))


def _gripper_mode(before: Float[np.ndarray, " 7"], after: Float[np.ndarray, " 7"]) -> GripperMode:
    change = after[GRIPPER] - before[GRIPPER]
    if abs(change) < GRIPS:
        return "held"
    return "close" if change > 0 else "open"
