"""Check excerpts of episodes without a model: do frames and states agree in time, and are both plausible?

The limits follow from measurements on simulated arms, BridgeData and DROID, unchanged and with artificial faults
(docs/data_reference.md). Each limit is far from the values of all unchanged data sets, so slight faults are not
reported.

                                           unchanged          with the fault                     limit
    fraction of poses that are stale       0 to 0.01          0.19 (every 5th), 0.80 (4 of 5)    0.05; error 0.5
    fraction of steps that are copied      0                  0.46 or more (each twice)          0.2
    fraction of frames that are repeated   0                  0.5 (each twice, poses are not)    0.2; error 0.9
    change between consecutive frames /
      change between distant frames        0.04 to 0.33       1.0 (noise)                        0.9
    median distance from the base          0.33 m to 0.60 m   0.02 m or less (differences)       0.05 m
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.spatial.transform import Rotation
from scipy.stats import rankdata

from vjepa2_ac import storage
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.errors import counted
from vjepa2_ac.inspection.coverage import read_each, select_sample
from vjepa2_ac.inspection.findings import Finding, Level
from vjepa2_ac.spaces import POSE, StateSpace

EPISODES, _EPISODES_AT_URL = 24, 12  # maximum number of episodes to read; an episode of DROID is about 5 MB
STEPS = 64  # control steps of an excerpt
_ROWS, _COLUMNS = 24, 32  # size of a small frame; an arm is still some pixels wide, and camera noise is averaged out
BLANK = 8.0  # frames with a lower contrast (0 to 255) count as black or uniform
_STILL_FRAME = 0.1  # changes below this fraction of an episode's median change are codec noise of a repeated frame
_STALE, _MOSTLY_STALE = 0.05, 0.5
_COPIED, _MOSTLY_COPIED = 0.2, 0.9
_FAR_LIKE_NEAR, _MIN_STEPS = 0.9, 8
_INSIDE_M, _DELTA_JUMPS = 0.05, 0.3

# Constants for the agreement of frames and states:
_MAX_LAG = 10  # maximum shift in control steps
_MIN_LENGTH_PER_LAG = 4  # minimum length of an excerpt, relative to the maximum shift
_NUM_PAIRINGS = 20  # pairings of each episode with the frames of another episode, to estimate the chance level
_MIN_EPISODES = 8  # with fewer episodes the chance level is too uncertain
_SURE = 3.0  # required number of standard errors, or of standard deviations of the chance level
_GAIN = 0.25  # required gain of another shift, relative to the correlation above chance
_BACKWARDS = 0.25  # required gain of the opposite order in an episode, and maximum fraction of such episodes
_ABOVE = 0.15  # minimum correlation above chance of matching frames; 0.3 or more was measured


@dataclass(frozen=True, eq=False)
class Excerpt:
    """Consecutive control steps of an episode, with frames that are converted to greyscale and a small size."""

    name: str  # the episode's identity
    states: Float[np.ndarray, "steps state_dim"]
    grey: Float32[np.ndarray, "steps rows columns"]  # 0 to 255

    @property
    def frame_change(self) -> Float[np.ndarray, " changes"]:
        """The mean absolute difference between consecutive frames, over all pixels."""
        return np.asarray(np.abs(np.diff(self.grey, axis=0)).mean(axis=(1, 2)), np.float64)


def read_excerpts(dataset: Dataset, *, episodes: int = EPISODES, steps: int = STEPS) -> Iterator[Excerpt]:
    """Yield the middle of the longest selected range of some episodes, which are selected deterministically.

    Episodes that cannot be read are skipped if `data.broken_episodes` allows it.

    Raises:
        InputError: As for `read_each`.
    """

    def read(index: int) -> Excerpt:
        start, end = max(dataset.selected_steps.ranges_of(index), key=lambda limits: limits[1] - limits[0])
        first = start + max(0, end - start - steps) // 2
        middle = range(first, min(end, first + steps))
        episode = dataset.read(index)
        states = np.asarray(episode.states[middle.start : middle.stop], np.float64)
        return Excerpt(episode.info.id, states, convert_to_small_grey(episode.read_frames(middle)))

    yield from (excerpt for _, excerpt in read_each(dataset, select_sample(dataset, episodes), read))


def convert_to_small_grey(
    frames: UInt8[np.ndarray, "steps height width 3"],
) -> Float32[np.ndarray, "steps rows columns"]:
    """Convert frames to greyscale and a small size by averaging. Smaller frames keep their size."""
    if len(frames) > 1:  # one frame at a time, because a float32 grey frame is larger than the colour frame
        return np.concatenate([convert_to_small_grey(frame[None]) for frame in frames])
    grey = frames.mean(axis=3, dtype=np.float32)
    for axis, target in ((1, _ROWS), (2, _COLUMNS)):
        size = grey.shape[axis]
        edges = np.linspace(0, size, min(target, size) + 1).astype(int)
        shape = [1, 1, 1]
        shape[axis] = -1
        grey = np.add.reduceat(grey, edges[:-1], axis=axis) / np.diff(edges).reshape(shape).astype(np.float32)
    return np.asarray(grey)


def limit_episodes(dataset: Dataset, episodes: int = EPISODES) -> int:
    """Return the maximum number of episodes to read: `episodes`, or fewer for data behind a URL."""
    return _EPISODES_AT_URL if storage.is_url(dataset.config.path) else episodes


def check_excerpts(dataset: Dataset) -> Iterator[Finding]:
    """Read excerpts of some episodes, and yield the findings about faults in them.

    Raises:
        InputError: An episode cannot be read, and `data.broken_episodes` does not skip it.
    """
    if dataset.config.is_cache:
        yield Finding("skipped", "agreement", "needs frames, found a latent cache. Check the original data set")
        return
    excerpts = list(read_excerpts(dataset, episodes=limit_episodes(dataset)))
    yield from excerpt_findings(excerpts, dataset.spaces.state, dataset.config.model_stride, dataset.control_rate_hz)


def excerpt_findings(
    excerpts: Sequence[Excerpt], space: StateSpace, stride: int, control_rate_hz: float
) -> Iterator[Finding]:
    """Yield the findings about faults in excerpts, and the agreement of frames and states."""
    excerpts = [excerpt for excerpt in excerpts if len(excerpt.states) > 1 and np.ptp(excerpt.grey) >= BLANK]
    if not excerpts:
        yield _check_agreement([], stride, control_rate_hz, is_sound=True)
        return
    motions = _compute_motions(excerpts, space)
    faults = [*_check_noise(excerpts), *_check_repetitions(excerpts, motions)]
    if space.position is not None:
        faults += _check_distances(excerpts)
    yield from faults
    pairs = [(motion, excerpt.frame_change) for motion, excerpt in zip(motions, excerpts, strict=True)]
    yield _check_agreement(pairs, stride, control_rate_hz, is_sound=not faults)


def _compute_motions(excerpts: Sequence[Excerpt], space: StateSpace) -> list[Float[np.ndarray, " _"]]:
    """Return the motion of each episode at each step: the sum of the changes of all numbers, relative to their RMS."""
    changes = [space.compute_differences(excerpt.states) for excerpt in excerpts]
    for change in changes if space.rotation is not None else ():
        change[:, space.rotation] = Rotation.from_euler("xyz", change[:, space.rotation]).as_rotvec()
    scale = np.sqrt((np.concatenate(changes) ** 2).mean(axis=0))
    scale = np.where(scale > 0, scale, np.inf)  # constant numbers add nothing
    return [np.abs(change / scale).sum(axis=1) for change in changes]


def _check_noise(excerpts: Sequence[Excerpt]) -> Iterator[Finding]:
    """Yield an error if consecutive frames differ as much as frames half an excerpt apart."""
    excerpts = [excerpt for excerpt in excerpts if len(excerpt.grey) >= _MIN_STEPS]
    near, far = sum(float(excerpt.frame_change.sum()) for excerpt in excerpts), 0.0
    for grey in (excerpt.grey for excerpt in excerpts):
        half = len(grey) // 2
        far += float(np.abs(grey[half:] - grey[: len(grey) - half]).mean()) * (len(grey) - 1)
    if far > 0 and near >= _FAR_LIKE_NEAR * far:
        text = f"consecutive frames differ by {100 * near / far:.0f} % of the difference of distant frames"
        yield Finding("error", "frames", f"{text}: they are noise, or out of order")


def _check_repetitions(excerpts: Sequence[Excerpt], motions: Sequence[Float[np.ndarray, " _"]]) -> Iterator[Finding]:
    """Yield findings about repeated poses with changing frames, repeated frames with changing poses, and both."""
    by_excerpt = [
        ((np.diff(excerpt.states, axis=0) == 0).all(axis=1), is_still(excerpt.frame_change)) for excerpt in excerpts
    ]
    is_single = np.concatenate([_find_isolated(same_pose & same_frame) for same_pose, same_frame in by_excerpt])
    same_pose, same_frame = (np.concatenate(masks) for masks in zip(*by_excerpt, strict=True))
    is_fast = np.concatenate([motion > np.median(motion) for motion in motions])
    level: Level
    if (stale := _fraction(same_pose, ~same_frame)) > _STALE:
        text = f"{100 * stale:.0f} % of the poses repeat the previous pose while the frame changes"
        level = "error" if stale > _MOSTLY_STALE else "warning"
        yield Finding(level, "stale poses", f"{text}: they are measured at a lower rate than the frames, or are stale")
    if (repeated := _fraction(same_frame, is_fast & ~same_pose)) > _COPIED:
        text = f"{100 * repeated:.0f} % of the frames repeat the previous frame while the robot moves"
        level = "error" if repeated > _MOSTLY_COPIED else "warning"
        yield Finding(level, "repeated", f"{text}: the camera has a lower rate. Check data.camera and the control rate")
    if (copied := float(is_single.mean())) > _COPIED:
        text = f"{100 * copied:.0f} % of the steps are single repetitions of the previous step"
        fix = "Check the control rate, or double data.stride"
        yield Finding("warning", "repeated", f"{text}: the data are recorded at a lower rate than stated. {fix}")


def is_still(change: Float[np.ndarray, " changes"]) -> Bool[np.ndarray, " changes"]:
    """Return a mask of the changes that are so small that the frame is a repetition with codec noise."""
    changing = change[change > 0]
    return np.asarray(change <= (_STILL_FRAME * np.median(changing) if len(changing) else 0.0))


def _fraction(mask: Bool[np.ndarray, " changes"], condition: Bool[np.ndarray, " changes"]) -> float:
    return float(mask[condition].mean()) if condition.any() else 0.0


def _find_isolated(mask: Bool[np.ndarray, " changes"]) -> Bool[np.ndarray, " changes"]:
    """Return a mask of the true values whose neighbours are both false."""
    padded = np.pad(mask, 1)
    return np.asarray(mask & ~padded[:-2] & ~padded[2:])


def _check_distances(excerpts: Sequence[Excerpt]) -> Iterator[Finding]:
    """Yield a finding if positions are too close to the robot's base, because they may be differences of positions."""
    positions = [excerpt.states[:, POSE.position] for excerpt in excerpts]
    median_m = float(np.median(np.linalg.norm(np.concatenate(positions), axis=1)))
    if not 0 < median_m < _INSIDE_M:
        return
    steps = np.concatenate([np.diff(position, axis=0) for position in positions])
    jumps = float(np.sqrt((steps**2).mean()) / np.sqrt((np.concatenate(positions) ** 2).mean()))
    text = f"half of the positions are within {median_m * 100:.1f} cm of the robot's base"
    if jumps > _DELTA_JUMPS:
        text += f" and change by {100 * jumps:.0f} % of their size at each step: they are differences, not poses"
        yield Finding("error", "position", f"{text}. Sum them, or choose the field with the measured pose")
    else:
        yield Finding("warning", "position", f"{text}. Check that they are in metres, in the frame of the base")


def _check_agreement(
    pairs: Sequence[tuple[Float[np.ndarray, " changes"], Float[np.ndarray, " changes"]]],
    stride: int,
    control_rate_hz: float,
    *,
    is_sound: bool,
) -> Finding:
    """Return the finding about the agreement in time between changes of frames and motion of states.

    Frames change more when the robot moves faster. The rank correlation between change and motion within an episode is
    0.5 or more on simulated arms at 15 Hz and on BridgeData at 5 Hz. With the frames of another episode, at the best of
    21 shifts, the correlation is 0.1 to 0.4. Three conclusions follow. The shift with the highest correlation is the
    delay of the frames. If the correlation is higher in the opposite order, the frames are reversed. If it is as low as
    with another episode, the frames belong to another episode.

    Args:
        pairs: For each episode the motion of the state and the change of the frame at each step, in any unit.
        stride: Control steps per model step. Many cameras lag by one control step: this is reported only at stride 1.
        control_rate_hz: Control steps per second, for the message.
        is_sound: Whether no other fault was found that explains a low correlation.
    """
    pairs = [pair for pair in pairs if all(len(values) and np.ptp(values) > 0 for values in pair)]
    median_steps = float(np.median([len(motion) for motion, _ in pairs])) if pairs else 0.0
    pairs = [pair for pair in pairs if len(pair[0]) >= median_steps / 2]  # shorter episodes allow few shifts
    if len(pairs) < _MIN_EPISODES or median_steps < _MIN_STEPS:
        needed = f"needs at least {_MIN_EPISODES} moving episodes of {_MIN_STEPS} or more steps"
        return Finding("skipped", "agreement", f"{needed}, found {len(pairs)} (median {median_steps:.0f} steps)")
    max_lag = min(_MAX_LAG, int(median_steps) // _MIN_LENGTH_PER_LAG)
    lags = range(-max_lag, max_lag + 1)  # control steps by which frames lag behind states
    motions, frame_changes = (_compute_ranks([pair[column] for pair in pairs]) for column in (0, 1))
    matching = _correlate(motions, frame_changes, lags)
    reversed_order = _correlate(motions, _compute_ranks([change[::-1] for _, change in pairs]), lags)
    shifts = range(1, min(len(pairs), _NUM_PAIRINGS + 1))
    other_episodes = np.array(
        [_correlate(motions, np.roll(frame_changes, -shift, axis=0), lags).mean(axis=0).max() for shift in shifts]
    )
    mean, best, chance = matching.mean(axis=0), int(matching.mean(axis=0).argmax()), other_episodes.mean()
    as_recorded, reverse = matching[:, best], reversed_order[:, int(reversed_order.mean(axis=0).argmax())]
    unshifted = matching[:, lags.index(0)]
    limit, lag = chance + _SURE * other_episodes.std(ddof=1), lags[best]
    measure = f"rank correlation of frame change and motion over {counted(len(pairs), 'episode')}:"
    text = f"{measure} {mean[best]:.2f}, with another episode's frames {chance:.2f}"
    if reverse.mean() > limit and _is_surely_above(reverse, as_recorded):
        text = f"{measure} {reverse.mean():.2f} with the frames reversed, {mean[best]:.2f} as recorded"
        return Finding("error", "agreement", f"frames and states have opposite orders in time ({text})")
    if mean[best] <= limit:
        highest = mean[best] + 2 * as_recorded.std(ddof=1) / np.sqrt(len(pairs))
        if highest < chance + _ABOVE and is_sound:
            fix = "Check that frames and states belong to the same episodes, and that the camera shows this robot"
            return Finding("warning", "agreement", f"frames do not change when the robot moves ({text}). {fix}")
        needed = "needs more episodes or more motion to decide whether frames and states belong together"
        return Finding("skipped", "agreement", f"{needed} ({text})")
    steps = counted(abs(lag), "step")
    shift = f"{steps} {'late' if lag > 0 else 'early'}"
    is_more = mean[best] - unshifted.mean() > _GAIN * (mean[best] - chance)
    if abs(lag) >= min(2, stride) and is_more and _is_surely_above(as_recorded, unshifted):
        text = f"{measure} {mean[best]:.2f} with shifted frames, {unshifted.mean():.2f} as recorded"
        fix = f"Give each frame the state of {steps} {'before' if lag > 0 else 'after'}"
        lag_text = f"frames are {'at least ' * (abs(lag) == max_lag)}{shift} ({abs(lag) / control_rate_hz:.2f} s)"
        level: Level = (
            "error" if abs(lag) >= stride else "warning"
        )  # from one model step on, each action has the frames of another action
        return Finding(level, "agreement", f"{lag_text}; {text}. {fix}")
    backwards = int((reverse - as_recorded > _BACKWARDS).sum())
    if backwards > _BACKWARDS * len(pairs):
        text = f"{backwards} of {counted(len(pairs), 'episode')} fit better with the frames in opposite order ({text})"
        return Finding("warning", "agreement", f"{text}. Check the order in time of frames and states")
    text += f"; it is highest for frames that are {shift}" if lag else ""
    return Finding("ok", "agreement", f"frames change when the robot moves ({text})")


def _compute_ranks(rows: Sequence[Float[np.ndarray, " _"]]) -> Float[np.ndarray, "rows longest"]:
    """Return the ranks of the values within each row, from 0 to 1. Shorter rows are padded with NaN."""
    ranks = np.full((len(rows), max(map(len, rows))), np.nan)
    for number, row in enumerate(rows):
        ranks[number, : len(row)] = rankdata(row) / len(row)
    return ranks


def _correlate(
    motions: Float[np.ndarray, "episodes longest"], frame_changes: Float[np.ndarray, "episodes longest"], lags: range
) -> Float[np.ndarray, "episodes lags"]:
    """Return the correlation of motion and frame change in each row, with frames shifted by each lag."""
    length = motions.shape[1]
    correlations = []
    for lag in lags:
        motion = motions[:, max(-lag, 0) : length - max(lag, 0)]
        change = frame_changes[:, max(lag, 0) : length - max(-lag, 0)]
        is_missing = np.isnan(motion + change)
        first, second = (np.where(is_missing, np.nan, values) for values in (motion, change))
        first, second = (values - np.nanmean(values, axis=1, keepdims=True) for values in (first, second))
        norm = np.sqrt(np.nansum(first**2, axis=1) * np.nansum(second**2, axis=1))
        correlations.append(np.nansum(first * second, axis=1) / np.where(norm > 0, norm, np.inf))
    return np.stack(correlations, axis=1)


def _is_surely_above(values: Float[np.ndarray, " episodes"], reference: Float[np.ndarray, " episodes"]) -> bool:
    difference = values - reference
    return bool(difference.mean() > _SURE * difference.std(ddof=1) / np.sqrt(len(difference)))
