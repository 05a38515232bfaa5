"""Signs of wrong states and frames that need no model: each is measured by itself, on neighbouring steps.

The limits follow from measurements (docs/log.md: simulated arms, BridgeData and DROID excerpts, unchanged and spoiled):
each limit is well away from all clean sets, so slight errors pass. Colours are an exception: nothing distinguishes a
blue world from swapped channels, so there is a hint only.

                                    clean sets                spoiled                              limit
    stale poses, share of steps     0 to 0.01                 0.19 (every 5th), 0.80 (4 of 5)      0.05; error 0.5
    copied steps, share             0                         0.46 and more (each twice)           0.2
    frames without motion, share    0                         0.5 (each twice, poses not)          0.2
    neighbours over far frames      0.04 to 0.33              1.0 (noise)                          0.9
    autocorrelation of motion       0.67 to 0.97              -0.35 and less (2 cm of noise)       -0.2
    median distance from base       0.33 m to 0.60 m          0.02 m and less (deltas)             0.05 m
    cold episodes, share            0; arm of domain A: 1     1 (BridgeData in BGR)                0.9
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from vjepa2_ac.data.inspection.excerpts import Excerpt
from vjepa2_ac.data.inspection.finding import Finding
from vjepa2_ac.spaces import POSE, StateSpace

_STILL_FRAME = 0.1  # of an episode's median change: the codec noise of a repeated frame
_STALE, _MOSTLY_STALE = 0.05, 0.5
_COPIED = 0.2
_FAR_LIKE_NEAR, _FEWEST_STEPS = 0.9, 8
_SHAKING, _SHAKING_M = -0.2, 0.002
_INSIDE_M, _DELTA_JUMPS = 0.05, 0.3
_FASTEST_M_S = 2.0  # Franka: 1.7
_COLD, _COLD_SHARE, _COLD_EPISODES = -0.4, 0.9, 8


def motion_in(excerpts: Sequence[Excerpt], space: StateSpace) -> list[Float[np.ndarray, " _"]]:
    """Return the motion of each episode at each step: the sum over its numbers, each in units of its typical change."""
    changes = [_change(one.states, space) for one in excerpts]
    scale = np.sqrt((np.concatenate(changes) ** 2).mean(axis=0))
    scale = np.where(scale > 0, scale, np.inf)  # constant numbers do not count
    return [np.abs(change / scale).sum(axis=1) for change in changes]


def _change(states: Float[np.ndarray, "steps dim"], space: StateSpace) -> Float[np.ndarray, "changes dim"]:
    change = np.diff(states, axis=0)
    if space.rotation is not None and len(change):  # angles jump at pi
        rotations = Rotation.from_euler("xyz", states[:, space.rotation])
        change[:, space.rotation] = (rotations[1:] * rotations[:-1].inv()).as_rotvec()
    return change


def noise_as_frames(excerpts: Sequence[Excerpt]) -> Finding | None:
    """Report neighbouring frames that differ as much as those half an excerpt apart."""
    excerpts = [one for one in excerpts if len(one.grey) >= _FEWEST_STEPS]
    near = sum(float(one.frame_change.sum()) for one in excerpts)
    far = sum(_far_change(one) * (len(one.grey) - 1) for one in excerpts)
    if not far > 0 or near < _FAR_LIKE_NEAR * far:
        return None
    text = f"neighbouring frames differ as much as far ones ({near / far:.0%}): noise, or frames in no order"
    return Finding("error", "pictures", text)


def _far_change(excerpt: Excerpt) -> float:
    half = len(excerpt.grey) // 2
    return float(np.abs(excerpt.grey[half:] - excerpt.grey[: len(excerpt.grey) - half]).mean()) if half else 0.0


def repetitions(excerpts: Sequence[Excerpt], moved: Sequence[Float[np.ndarray, " _"]]) -> Iterator[Finding]:
    """Yield repetitions: of poses while frames change, of frames while poses change, or of single steps of both.

    Args:
        excerpts: Some episodes.
        moved: How far each has moved at each step, in any unit.
    """
    held = np.concatenate([(np.diff(one.states, axis=0) == 0).all(axis=1) for one in excerpts])
    still = np.concatenate([_is_still(one.frame_change) for one in excerpts])
    fast = np.concatenate([one > np.median(one) for one in moved])
    if (stale := _share(held, ~still)) > _STALE:
        text = f"{stale:.0%} repeat the one before while the frame changes: measured more seldom, or stale"
        yield Finding("error" if stale > _MOSTLY_STALE else "warning", "stale poses", text)
    if (shown_again := _share(still, fast & ~held)) > _COPIED:
        text = f"{shown_again:.0%} of the frames repeat the one before while the robot moves"
        yield Finding("warning", "repeated", f"{text}: filmed at a lower rate. Check the control rate")
    singly = np.concatenate([_alone(one) for one in _by_episode(held & still, excerpts)])
    if len(singly) and (copied := float(singly.mean())) > _COPIED:
        text = f"{copied:.0%} of the steps repeat the one before, singly: recorded at a lower rate than stated"
        yield Finding("warning", "repeated", f"{text}. Check the control rate, or double data.stride")


def _is_still(change: Float[np.ndarray, " changes"]) -> Bool[np.ndarray, " changes"]:
    changing = change[change > 0]
    return np.asarray(change <= (_STILL_FRAME * np.median(changing) if len(changing) else 0.0))


def _share(mask: Bool[np.ndarray, " changes"], among: Bool[np.ndarray, " changes"]) -> float:
    return float(mask[among].mean()) if among.any() else 0.0


def _by_episode(mask: Bool[np.ndarray, " changes"], excerpts: Sequence[Excerpt]) -> list[Bool[np.ndarray, " _"]]:
    ends = np.cumsum([len(one.grey) - 1 for one in excerpts])
    return np.split(mask, ends[:-1])


def _alone(mask: Bool[np.ndarray, " changes"]) -> Bool[np.ndarray, " changes"]:
    """Return which values are true while both neighbours are not."""
    padded = np.pad(mask, 1)
    return np.asarray(mask & ~padded[:-2] & ~padded[2:])


def shaking(excerpts: Sequence[Excerpt]) -> Finding | None:
    """Report positions that go back and forth from step to step, like noise and unlike an arm.

    The autocorrelation of the motion is near 1 for an arm and -0.5 for noise alone; it is below the limit if the
    noise, on each axis, is about as large as the arm's motion in a step.
    """
    ways = [np.diff(one.states[:, POSE.position], axis=0) for one in excerpts]
    size = sum(float((way**2).sum()) for way in ways)
    jerks = np.concatenate([np.diff(way, n=2, axis=0) for way in ways])
    if not size > 0 or not len(jerks):
        return None
    autocorrelation = sum(float((way[1:] * way[:-1]).sum()) for way in ways) / size
    noise_m = float(np.sqrt((jerks**2).mean() / 20))  # 20: of the third difference of white noise, beside the noise
    if autocorrelation > _SHAKING or noise_m < _SHAKING_M:
        return None
    text = f"positions shake by {noise_m * 100:.1f} cm from step to step, more than the arm moves"
    return Finding("warning", "noise", f"{text}. Actions are mostly noise: smooth the poses, or widen data.stride")


def deltas_for_poses(excerpts: Sequence[Excerpt]) -> Finding | None:
    """Report positions that are impossible for a flange: at the base, as differences of positions are."""
    positions = [one.states[:, POSE.position] for one in excerpts]
    median_m = float(np.median(np.linalg.norm(np.concatenate(positions), axis=1)))
    if not 0 < median_m < _INSIDE_M:
        return None
    steps = np.concatenate([np.diff(one, axis=0) for one in positions])
    jumps = float(np.sqrt((steps**2).mean()) / np.sqrt((np.concatenate(positions) ** 2).mean()))
    text = f"half of the positions lie within {median_m * 100:.1f} cm of the robot's base"
    if jumps > _DELTA_JUMPS:
        text += f", and change by {jumps:.0%} of that from step to step: differences, not poses"
        return Finding("error", "position", f"{text}. Sum them up, or choose the field with the measured pose")
    return Finding("warning", "position", f"{text}: poses are needed in the frame of the base, in metres")


def too_fast(excerpts: Sequence[Excerpt], control_rate_hz: float) -> Finding | None:
    """Report a flange that is faster than arms: the control rate, or the unit, may be wrong."""
    steps = np.concatenate([np.diff(one.states[:, POSE.position], axis=0) for one in excerpts])
    fast = float(np.percentile(np.linalg.norm(steps, axis=1), 99)) * control_rate_hz if len(steps) else 0.0
    if fast < _FASTEST_M_S:
        return None
    text = f"the flange moves at {fast:.1f} m/s (99 % of the steps are slower): faster than common arms"
    return Finding("warning", "speed", f"{text}. Is the control rate right, and is it metres?")


def blue_hint(excerpts: Sequence[Excerpt]) -> Finding | None:
    """Hint if colours are cold in nearly all episodes, which is rare for rooms, wood and skin, but no error."""
    warmth = np.array([one.warmth for one in excerpts])
    if len(warmth) < _COLD_EPISODES or (warmth < _COLD).mean() < _COLD_SHARE:
        return None
    text = (
        f"hint: what is strongly coloured is more blue than red in {(warmth < _COLD).sum()} of {len(warmth)} episodes"
    )
    return Finding("ok", "colours", f"{text}: look whether red and blue are exchanged (BGR), with `data inspect`")
