"""Key frames of a demonstration: which of its frames are worth being goals, and how long each may take. Pure functions.

A frame is a recorded moment: a control step of an episode, a frame of a film, or a model step.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from vjepa2_ac.planning.goals import GripperMode, SubGoal
from vjepa2_ac.planning.search_space import GRIPPER
from vjepa2_ac.spaces import actions_from_states

States = Float[np.ndarray, "frames 7"]

GRIPS = 0.15  # of closedness: less is no change of the gripper
_MOVES = 0.02  # of closedness, from one frame to the next: less is no motion of the fingers
_PAUSE = 2  # frames that the fingers may rest within one change
_STILL_M, _STILL_RAD = 0.002, 0.02  # from one frame to the next: less is a resting arm
_LEFT_M = 0.01  # farther from where it gripped, an arm has left
_SAME_M, _SAME_RAD = 0.005, 0.05  # less apart in all are two images of the same state


@dataclass(frozen=True)
class KeyFrame:
    """A frame that becomes a goal."""

    frame: int
    name: str  # why it was taken, in a few words


@dataclass(frozen=True)
class StillRule:
    """What is a stop of the arm, and how near one another goals may be; in frames."""

    lasts: int = 4  # a shorter rest is no stop
    apart: int = 4  # a stop nearer than this to another key frame is left out


OF_MODEL_STEPS = StillRule(lasts=1, apart=1)
"""Where a frame is a model step."""


def gripper_key_frames(states: States, rule: StillRule | None = None) -> tuple[KeyFrame, ...]:
    """Return where the gripper begins to change and where it has changed, where the arm stops, and the end.

    Where the arm leaves before the fingers have come to rest, the gripper has changed at the last frame before that, if
    half of the change is done by then. The start is no key frame. Where the arm rests at the end, the end is the frame
    at which it came to rest.

    Args:
        states: Measured, with closedness last (legend: `vjepa2_ac.episode`).
        rule: What counts as a stop.

    Raises:
        ValueError: Fewer than two frames.

    Source of the idea: peract @ 02fb876, helpers/demo_loading_utils.py, keypoint_discovery. Theirs takes the frame
    after a binary gripper has changed, and stops by joint velocities; here a change has a beginning and an end.
    """
    rule, last = rule or StillRule(), len(states) - 1
    found: dict[int, str] = {}
    changes = _gripper_changes(states[:, GRIPPER])
    for begin, end in changes:
        closes = states[end, GRIPPER] > states[begin, GRIPPER]
        if begin >= rule.apart:
            found.setdefault(begin, "before closing" if closes else "before opening")
        found[_before_leaving(states, begin, end)] = "closed" if closes else "opened"
    for begin in _stops(states, rule.lasts):
        near = [abs(begin - frame) < rule.apart for frame in (0, last, *found)]
        if not any(near) and not any(first <= begin <= end for first, end in changes):
            found[begin] = "stop"
    if not found or not _is_same(states[max(found)], states[last]):
        found[last] = "end"
    elif found[max(found)] == "stop":
        found[max(found)] = "end"
    return tuple(KeyFrame(frame, found[frame]) for frame in sorted(found))


def _gripper_changes(closedness: Float[np.ndarray, " frames"]) -> list[tuple[int, int]]:
    """Return first and last frame of each change of the gripper in one direction."""
    found: list[tuple[int, int, float]] = []
    for frame, way in enumerate(np.diff(closedness)):
        if abs(way) < _MOVES:
            continue
        if found and found[-1][2] == np.sign(way) and frame - found[-1][1] <= _PAUSE:
            found[-1] = (found[-1][0], frame + 1, found[-1][2])
        else:
            found.append((frame, frame + 1, float(np.sign(way))))
    return [(begin, end) for begin, end, _ in found if abs(closedness[end] - closedness[begin]) >= GRIPS]


def _before_leaving(states: States, begin: int, end: int) -> int:
    """Return the last frame of a change of the gripper at which the arm is where it began, or the end of the change."""
    changed = np.abs(states[begin : end + 1, GRIPPER] - states[begin, GRIPPER])
    moved = np.linalg.norm(states[begin : end + 1, :3] - states[begin, :3], axis=1)
    there = np.flatnonzero((moved < _LEFT_M) & (changed >= max(GRIPS, changed[-1] / 2)))
    return begin + int(there[-1]) if len(there) else end


def _stops(states: States, lasts: int) -> list[int]:
    """Return where the arm comes to rest for at least so many frames; at the start it has not come to rest."""
    still = _are_below(actions_from_states(states), _STILL_M, _STILL_RAD, _MOVES)
    begins = [frame for frame in range(1, len(still)) if still[frame] and not still[frame - 1]]
    return [begin for begin in begins if still[begin : begin + lasts].all() and begin + lasts <= len(still)]


def _is_same(one: Float[np.ndarray, " 7"], other: Float[np.ndarray, " 7"]) -> bool:
    return bool(_are_below(actions_from_states(np.stack([one, other])), _SAME_M, _SAME_RAD, GRIPS)[0])


def _are_below(
    changes: Float[np.ndarray, "pairs 7"], metres: float, radians: float, closedness: float
) -> Bool[np.ndarray, " pairs"]:
    moved, turned = (np.linalg.norm(changes[:, part], axis=1) for part in (slice(0, 3), slice(3, 6)))
    return np.asarray((moved < metres) & (turned < radians) & (np.abs(changes[:, GRIPPER]) < closedness))


def with_frames_between(keys: Sequence[KeyFrame], step: int, name: str = "on the way") -> tuple[KeyFrame, ...]:
    """Return key frames, and on the way to each of them every `step`-th frame from the one before, or from the start.

    A planner that sees one step ahead goes straight for a distant goal, with every axis at its limit. Near goals show
    it the way. A frame less than half a step before a key frame is left out.

    Args:
        keys: In order.
        step: Frames from one goal to the next.
        name: Of the further ones, `{}` in it their number.
    """
    found: list[KeyFrame] = []
    for before, key in itertools.pairwise((KeyFrame(0, "start"), *keys)):
        ways = [one for one in range(before.frame + step, key.frame, step) if 2 * (key.frame - one) >= step]
        found += [*(KeyFrame(one, name.format(one)) for one in ways), key]
    return tuple(found)


def every_key_frame(frames: int, step: int) -> tuple[KeyFrame, ...]:
    """Return every `step`-th frame but the first, and the last; one less than half a step before the last is left out.

    Args:
        frames: Of the demonstration, two or more.
        step: From one key frame to the next, one or more.
    """
    return with_frames_between([KeyFrame(frames - 1, "end")], step, "frame {}")


@dataclass(frozen=True)
class Timing:
    """How long goals of a demonstration apply."""

    stride: int = 1  # frames of a model step
    slack: int = 3  # model steps that a goal may take fewer or more than the demonstration
    share: float | None = None  # of each goal but the last
    stop_share: float | None = None  # of the last one


def sub_goals_of(
    images: Sequence[np.ndarray], keys: Sequence[KeyFrame], timing: Timing, states: States | None = None
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
        steps = max(1, math.ceil((key.frame - before) / timing.stride))
        gripper = None if states is None else _gripper_mode(states[before], states[key.frame])
        low, high = max(1, steps - timing.slack), steps + timing.slack
        goals.append(SubGoal(image, key.name, low, high, timing.share, gripper))
        before = key.frame
    return (*goals[:-1], replace(goals[-1], at_most=None, share=timing.stop_share))


def _gripper_mode(before: Float[np.ndarray, " 7"], after: Float[np.ndarray, " 7"]) -> GripperMode:
    change = after[GRIPPER] - before[GRIPPER]
    if abs(change) < GRIPS:
        return "held"
    return "close" if change > 0 else "open"
