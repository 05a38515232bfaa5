"""Select key frames of a demonstration, and turn them into goals with durations.

A frame is a control step of an episode, a frame of a video, or a model step.
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

MIN_GRIPPER_CHANGE = 0.15  # smallest difference of gripper position that counts as a change of the gripper
_MIN_FINGER_MOTION = 0.02  # smallest change of gripper position between two frames that counts as motion of the fingers
_MAX_PAUSE = 2  # frames for which the fingers may rest within one change
_STILL_M, _STILL_RAD = 0.002, 0.02  # the arm rests if it moves less than this between two frames
_MIN_DEPARTURE_M = 0.01  # the arm has left the position of a grip if it is at least this far away
_SAME_M, _SAME_RAD = 0.005, 0.05  # two states count as equal if they differ by less than this


@dataclass(frozen=True)
class KeyFrame:
    """A frame that becomes a goal."""

    frame: int
    name: str  # reason of the choice, such as "closed" or "stop"


@dataclass(frozen=True)
class StillRule:
    """Rule for stops of the arm; all values are in frames."""

    min_rest: int = 4  # shortest rest that counts as a stop
    min_distance: int = 4  # a stop closer than this to another key frame is left out


MODEL_STEP_RULE = StillRule(min_rest=1, min_distance=1)
"""The rule if a frame is a model step."""


def find_gripper_key_frames(states: States, rule: StillRule | None = None) -> tuple[KeyFrame, ...]:
    """Return the frames at which the gripper begins and ends to change, the stops of the arm, and the last frame.

    If the arm leaves before the fingers rest, the change ends at the last frame before the arm leaves, provided that
    half of the change is done by then. The first frame is never a key frame. If the arm rests at the end, the frame at
    which the arm came to rest replaces the last frame.

    Args:
        states: Measured states, with gripper position last (conventions: `vjepa2_ac.episode`).
        rule: The rule for stops.

    Raises:
        ValueError: Fewer than two frames.

    Source of the idea: peract @ 02fb876, helpers/demo_loading_utils.py, keypoint_discovery. That function takes the
    frame after a binary gripper has changed, and finds stops by joint velocities; here a change has a beginning and an
    end.
    """
    rule, last = rule or StillRule(), len(states) - 1
    names: dict[int, str] = {}  # by frame
    changes = _find_gripper_changes(states[:, GRIPPER])
    for begin, end in changes:
        is_closing = states[end, GRIPPER] > states[begin, GRIPPER]
        if begin >= rule.min_distance:
            names.setdefault(begin, "before closing" if is_closing else "before opening")
        names[_find_end_of_change(states, begin, end)] = "closed" if is_closing else "opened"
    for begin in _find_stops(states, rule.min_rest):
        is_near = any(abs(begin - frame) < rule.min_distance for frame in (0, last, *names))
        if not is_near and not any(first <= begin <= end for first, end in changes):
            names[begin] = "stop"
    if not names or not _is_same(states[max(names)], states[last]):
        names[last] = "end"
    elif names[max(names)] == "stop":
        names[max(names)] = "end"
    return tuple(KeyFrame(frame, names[frame]) for frame in sorted(names))


def _find_gripper_changes(gripper_position: Float[np.ndarray, " frames"]) -> list[tuple[int, int]]:
    """Return the first and the last frame of each change of the gripper in one direction."""
    changes: list[tuple[int, int, float]] = []  # first frame, last frame, direction
    for frame, difference in enumerate(np.diff(gripper_position)):
        if abs(difference) < _MIN_FINGER_MOTION:
            continue
        if changes and changes[-1][2] == np.sign(difference) and frame - changes[-1][1] <= _MAX_PAUSE:
            changes[-1] = (changes[-1][0], frame + 1, changes[-1][2])
        else:
            changes.append((frame, frame + 1, float(np.sign(difference))))
    return [
        (begin, end)
        for begin, end, _ in changes
        if abs(gripper_position[end] - gripper_position[begin]) >= MIN_GRIPPER_CHANGE
    ]


def _find_end_of_change(states: States, begin: int, end: int) -> int:
    """Return the last frame of a gripper change before the arm leaves its position, or the end of the change."""
    changed = np.abs(states[begin : end + 1, GRIPPER] - states[begin, GRIPPER])
    moved = np.linalg.norm(states[begin : end + 1, :3] - states[begin, :3], axis=1)
    candidates = np.flatnonzero((moved < _MIN_DEPARTURE_M) & (changed >= max(MIN_GRIPPER_CHANGE, changed[-1] / 2)))
    return begin + int(candidates[-1]) if len(candidates) else end


def _find_stops(states: States, min_rest: int) -> list[int]:
    """Return the frames at which the arm comes to rest for at least `min_rest` frames, except a rest at the start."""
    still = _are_below(actions_from_states(states), _STILL_M, _STILL_RAD, _MIN_FINGER_MOTION)
    begins = [frame for frame in range(1, len(still)) if still[frame] and not still[frame - 1]]
    return [begin for begin in begins if still[begin : begin + min_rest].all() and begin + min_rest <= len(still)]


def _is_same(first: Float[np.ndarray, " 7"], second: Float[np.ndarray, " 7"]) -> bool:
    return bool(_are_below(actions_from_states(np.stack([first, second])), _SAME_M, _SAME_RAD, MIN_GRIPPER_CHANGE)[0])


def _are_below(
    changes: Float[np.ndarray, "pairs 7"], metres: float, radians: float, gripper_position: float
) -> Bool[np.ndarray, " pairs"]:
    moved, turned = (np.linalg.norm(changes[:, part], axis=1) for part in (slice(0, 3), slice(3, 6)))
    return np.asarray((moved < metres) & (turned < radians) & (np.abs(changes[:, GRIPPER]) < gripper_position))


def add_frames_between(keys: Sequence[KeyFrame], step: int, name: str = "on the way") -> tuple[KeyFrame, ...]:
    """Add to key frames every `step`-th frame between them, counted from the previous key frame or the start.

    A planner with a horizon of one step moves straight towards a distant goal, with all axes at their limits. Closer
    goals keep it on the demonstrated path. A frame less than half a step before a key frame is left out.

    Args:
        keys: The key frames, in order.
        step: Number of frames from one goal to the next.
        name: Name of the additional key frames; `{}` is replaced by the frame's number.
    """
    all_frames: list[KeyFrame] = []
    for previous, key in itertools.pairwise((KeyFrame(0, "start"), *keys)):
        between = [frame for frame in range(previous.frame + step, key.frame, step) if 2 * (key.frame - frame) >= step]
        all_frames += [*(KeyFrame(frame, name.format(frame)) for frame in between), key]
    return tuple(all_frames)


def select_every_nth_frame(frames: int, step: int) -> tuple[KeyFrame, ...]:
    """Return every `step`-th frame except the first, and the last frame.

    A frame less than half a step before the last frame is left out.

    Args:
        frames: Number of frames of the demonstration, two or more.
        step: Number of frames from one key frame to the next, one or more.
    """
    return add_frames_between([KeyFrame(frames - 1, "end")], step, "frame {}")


@dataclass(frozen=True)
class Timing:
    """Rules for the durations of goals from a demonstration."""

    stride: int = 1  # frames per model step
    slack: int = 3  # a goal may take this number of model steps fewer or more than the demonstration
    share: float | None = None  # `SubGoal.share` of each goal but the last
    stop_share: float | None = None  # `SubGoal.share` of the last goal


def make_sub_goals(
    images: Sequence[np.ndarray], keys: Sequence[KeyFrame], timing: Timing, states: States | None = None
) -> tuple[SubGoal, ...]:
    """Return key frames as goals, with the demonstration's durations and, if states are given, gripper modes.

    The gripper closes on the way to a key frame at which it is more closed than at the previous key frame, opens
    if it is more open, and otherwise does not move.

    Args:
        images: Images of the key frames.
        keys: The key frames.
        timing: Rules for the durations.
        states: States of all frames of the demonstration; None: the gripper mode is that of planning.limits.
    """
    goals, previous_frame = [], 0
    for image, key in zip(images, keys, strict=True):
        steps = max(1, math.ceil((key.frame - previous_frame) / timing.stride))
        gripper = None if states is None else _get_gripper_mode(states[previous_frame], states[key.frame])
        low, high = max(1, steps - timing.slack), steps + timing.slack
        goals.append(SubGoal(image, key.name, low, high, timing.share, gripper))
        previous_frame = key.frame
    return (*goals[:-1], replace(goals[-1], at_most=None, share=timing.stop_share))


def _get_gripper_mode(before: Float[np.ndarray, " 7"], after: Float[np.ndarray, " 7"]) -> GripperMode:
    change = after[GRIPPER] - before[GRIPPER]
    if abs(change) < MIN_GRIPPER_CHANGE:
        return "held"
    return "close" if change > 0 else "open"
