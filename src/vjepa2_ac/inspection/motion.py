"""Check motion and episode ends: impossible speeds, padding, lost measurements, rotation formats, frozen frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32

from vjepa2_ac.config.data import RotationFormat
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.index import MEANS, SPANS
from vjepa2_ac.data.poses import MIN_JUMPS, find_smoother_format, measure_rotation_speeds, num_rotation_numbers
from vjepa2_ac.data.selection import format_identities
from vjepa2_ac.data.sources.indexed_source import IndexedSource
from vjepa2_ac.errors import counted
from vjepa2_ac.inspection.coverage import PERCENTILE, ReadEpisode, read_each, read_sample, sample_of
from vjepa2_ac.inspection.excerpts import BLANK, affordable, is_still, small_grey
from vjepa2_ac.inspection.findings import Finding, duplicates_finding, first_case
from vjepa2_ac.spaces import POSE, compute_step_sizes

_EPISODES = 200
_MIDDLES = 64  # episodes whose middle frame is read
_MOST_FAST = 200  # largest number of too fast episodes that are read to name their steps
# Measured: with half of the episodes at half the scale the groups are 5.8 (BridgeData) and 9.0 (simulated arm)
# deviations apart, otherwise at most 4.0.
_FEWEST_SCALED, _SEPARATION, _SCALE, _SAME_SHAPE = 4, 5.0, 1.4, 0.2
_END_STEPS = 16  # steps at each end of an episode whose frames are read
_MIN_FROZEN = 3  # single repeated frames come from a camera with a lower rate
_MOVED_M = 0.01  # smallest motion that is visible in an image
FASTEST_M_S, FASTEST_RAD_S = 2.5, 10.0  # speeds between control steps that no arm reaches
_FARTHER = 1.5  # a step from or to zeros above this multiple of the 99th percentile of steps is no motion
_EXCLUDE = "Remove these steps from the data set, or list the episodes in data.exclude"


class Stretch(NamedTuple):
    """Consecutive control steps of an episode that are used in training."""

    name: str  # the episode's identity
    start: int  # the first step
    states: Float[np.ndarray, "steps 7"]


def check_motion(dataset: Dataset) -> Iterator[Finding]:
    """Read the states of some episodes, and frames at the ends of fewer, and yield the findings about their motion.

    Raises:
        InputError: An episode cannot be read, and `data.broken_episodes` does not skip it.
    """
    if dataset.spaces.state.position is None:
        for name in ("scale", "speed", "padding", "rotation format"):
            yield Finding("skipped", name, "needs poses (data.states: pose), found vectors")
    else:
        sample = list(read_sample(dataset, affordable(dataset, _EPISODES), also=_fast_episodes(dataset)))
        yield scale_finding(dataset)
        yield from _check_states(dataset, sample)
        yield from _check_rotation_format(dataset, sample)
    if dataset.config.is_cache:
        yield Finding(
            "skipped", "episode ends", "needs frames, found a latent cache. Check the data set it was made from"
        )
    else:
        yield _check_middles(dataset)
        yield _check_ends(dataset)


def warnings_from_index(dataset: Dataset) -> list[Finding]:
    """Return the warnings that need no frames: duplicates, another scale, and impossible speeds.

    Only episodes that are too fast according to the index are read.

    Raises:
        InputError: As for `check_motion`.
    """
    findings = [duplicates_finding(dataset)]
    if dataset.config.states == "pose":
        sample = list(read_sample(dataset, 0, also=_fast_episodes(dataset)))
        findings += scale_finding(dataset), *_check_states(dataset, sample)
    return [finding for finding in findings if finding.level == "warning"]


def scale_finding(dataset: Dataset) -> Finding:
    """Return the finding about groups of episodes whose positions differ in scale, as with different units."""
    radii_m, spans_m = (np.linalg.norm(dataset.table.motion[:, part], axis=1) for part in (MEANS, SPANS))
    members = dataset.episodes[(radii_m * spans_m)[dataset.episodes] > 0]  # not those of unknown motion
    if len(members) < 2 * _FEWEST_SCALED:
        needed = f"needs poses in the index of {2 * _FEWEST_SCALED} or more episodes, found {len(members)}"
        return Finding("skipped", "scale", needed)
    members = members[np.argsort(radii_m[members])]
    radii_m, directions = radii_m[members], dataset.table.motion[members, MEANS] / radii_m[members, None]
    features = np.column_stack([np.log(radii_m), directions, np.log(spans_m[members] / radii_m)])
    gaps = np.diff(features[:, 0])[_FEWEST_SCALED - 1 : len(members) - _FEWEST_SCALED]
    near, far = np.split(features, [_FEWEST_SCALED + int(gaps.argmax())])
    change, noise = far.mean(axis=0) - near.mean(axis=0), np.sqrt((near[:, 0].var() + far[:, 0].var()) / 2)
    compared = f"{len(members):,} of {counted(len(dataset.episodes), 'episode')} compared"
    if change[0] < max(_SEPARATION * noise, np.log(_SCALE)) or np.linalg.norm(change[1:]) > _SAME_SHAPE:
        return Finding("ok", "scale", f"no group of episodes has positions at another scale ({compared})")
    example, factor = dataset.table.identity(int(members[len(near)])), np.exp(change[0])
    text = f"{counted(len(far), 'episode')}, such as {example}, have positions and motions {factor:.2f} times as large"
    return Finding("warning", "scale", f"{text} as the other {len(near):,} ({compared}). Check the unit of both groups")


def _fast_episodes(dataset: Dataset) -> list[int]:
    """Return at most 200 episodes with a step that is faster than any arm according to the index, fastest first."""
    members = dataset.episodes
    excess = (dataset.table.motion[members, :2] / [FASTEST_M_S, FASTEST_RAD_S]).max(axis=1)
    order = np.argsort(-excess)[: int((excess * dataset.control_rate_hz > 1).sum())]
    return [int(index) for index in members[order[:_MOST_FAST]]]


def _check_states(dataset: Dataset, sample: Sequence[ReadEpisode]) -> Iterator[Finding]:
    """Yield the findings about speed and padding; for episodes that were not read, the index contains the speed."""
    num_indexed = int((dataset.table.motion[dataset.episodes, 0] >= 0).sum())
    checked = f"{len(sample):,} of {counted(len(dataset.episodes), 'episode')} checked"
    by_index = f", {num_indexed:,} by the index" if num_indexed > len(sample) else ""
    stretches = [
        Stretch(dataset.table.identity(episode.index), start, episode.states[start:end])
        for episode in sample
        for start, end in episode.selected
        if end - start > 1
    ]
    yield speed_finding(stretches, dataset.control_rate_hz, checked + by_index)
    yield padding_finding(stretches, checked)


def speed_finding(stretches: Sequence[Stretch], control_rate_hz: float, checked: str) -> Finding:
    """Return the finding about poses that change faster between control steps than an arm can move.

    Args:
        stretches: Steps of some episodes.
        control_rate_hz: Control steps per second.
        checked: The number of episodes, for the text.
    """
    if not stretches:
        return Finding("skipped", "speed", "needs episodes of two or more steps, found none")
    speeds, turns = control_rate_hz * np.concatenate([compute_step_sizes(stretch.states) for stretch in stretches]).T
    excess = np.maximum(speeds / FASTEST_M_S, turns / FASTEST_RAD_S)
    if excess.max() <= 1:
        text = f"at most {speeds.max():.2f} m/s and {turns.max():.2f} rad/s between control steps ({checked})"
        return Finding("ok", "speed", text)
    steps = [(stretch.name, stretch.start + step) for stretch in stretches for step in range(len(stretch.states) - 1)]
    fast, worst = np.flatnonzero(excess > 1).tolist(), int(excess.argmax())
    name, step = steps[worst]
    episodes = counted(len({steps[index][0] for index in fast}), "episode")
    limit = f"{FASTEST_M_S:g} m/s or {FASTEST_RAD_S:g} rad/s, which no arm reaches"
    text = f"faster than {limit}: {counted(len(fast), 'control step')} in {episodes} ({checked})"
    example = f"{name}, step {step} to {step + 1}: {speeds[worst]:.1f} m/s, {turns[worst]:.1f} rad/s"
    fix = "Look for padding, lost measurements and joined recordings"
    return Finding("warning", "speed", f"{text}. Example: {example}. {fix}")


def padding_finding(stretches: Sequence[Stretch], checked: str) -> Finding:
    """Return the finding about poses that are exactly zero although the previous or next pose is far away.

    Poses relative to the first state of an episode also start with zeros, but then the robot moves away slowly.
    """
    runs: list[tuple[float, str, int, int]] = []  # farthest step from or to the zeros, identity, first step, end
    moves_m = [np.zeros(1)]
    for name, start, states in stretches:
        is_zero = np.all(states[:, : POSE.gripper] == 0, axis=1)
        steps_m = np.linalg.norm(np.diff(states[:, POSE.position], axis=0), axis=1)
        moves_m.append(steps_m[~(is_zero[1:] | is_zero[:-1])])
        for first, end in np.flatnonzero(np.diff(np.pad(is_zero.astype(int), 1))).reshape(-1, 2).tolist():
            farthest_m = np.inf if end - first == len(states) else float(steps_m[max(0, first - 1) : end].max())
            runs.append((farthest_m, name, start + first, start + end))
    least_m = _FARTHER * float(np.percentile(np.concatenate(moves_m), PERCENTILE))
    padding = [run for run in runs if run[0] > least_m]
    if not padding:
        return Finding("ok", "padding", f"no padding with zeros ({checked})")
    zeros = counted(sum(end - first for *_, first, end in padding), "state")
    episodes = counted(len({name for _, name, *_ in padding}), "episode")
    _, name, first, end = max(padding, key=lambda run: run[3] - run[2])
    example = f"step {first}" if end - first == 1 else f"steps {first} to {end - 1}"
    text = f"{zeros} in {episodes} with a position and a rotation of exactly zero: padding or lost measurements"
    return Finding("warning", "padding", f"{text} ({checked}). Example: {name}, {example}. {_EXCLUDE}")


def _check_rotation_format(dataset: Dataset, sample: Sequence[ReadEpisode]) -> Iterator[Finding]:
    """Yield the finding about rotations that are smoother if they are read in another format."""
    config, source, about = dataset.config, dataset.source, "rotation format"
    if config.is_cache:
        yield Finding(
            "skipped", about, "needs recorded rotations, found a latent cache. Check the data set it was made from"
        )
        return
    section, fields = config.pose_fields
    configured: RotationFormat = "euler_xyz" if fields is None else fields.rotation
    if num_rotation_numbers(configured) == 4:  # a quaternion has the same speed in both orders
        return
    states = {episode.index: episode.states for episode in sample}
    if configured != "euler_xyz" and isinstance(source, IndexedSource):
        raw = source.with_raw_states()
        states = {index: np.asarray(episode.states) for index, episode in read_each(dataset, [*states], raw.read)}
    numbers = [
        rows[start:end, POSE.rotation]
        for index, rows in states.items()
        for start, end in dataset.selected_steps.ranges_of(index)
    ]
    speeds = measure_rotation_speeds(numbers, dataset.control_rate_hz)
    if smoother := find_smoother_format(speeds, configured, FASTEST_RAD_S):
        readings = "; ".join(
            f"read as {name}, the median speed is {speed.median_rad_s:.2f} rad/s and the rotation is smooth at"
            f" {speed.num_smooth_jumps} of {speed.num_jumps} jumps of the rotation numbers"
            for name, speed in speeds.items()
            if name in {configured, smoother}
        )
        fix = f"Set data.{section}.rotation: {smoother}" if section else "Write extrinsic xyz Euler angles in radians"
        yield Finding("warning", about, f"{readings}. {fix}")
        return
    as_configured, alternatives = speeds[configured], [speed for name, speed in speeds.items() if name != configured]
    decisive = min(map(as_configured.num_smoother_than, alternatives), default=MIN_JUMPS)
    if decisive < MIN_JUMPS:
        needed = f"needs at least {MIN_JUMPS} jumps of the rotation numbers (such as an angle that passes pi)"
        yield Finding("skipped", about, f"{needed} to distinguish formats, found {decisive}")
    else:
        smooth, jumps = as_configured.num_smooth_jumps, as_configured.num_jumps
        text = f"read as {configured}, the rotation is smooth at {smooth} of {jumps} jumps of the rotation numbers"
        yield Finding("ok", about, f"{text}, and at fewer in every other format")


def _check_ends(dataset: Dataset) -> Finding:
    """Return the finding about black and frozen frames at the ends of episodes."""
    is_pose = dataset.spaces.state.position is not None

    def read(index: int) -> list[tuple[int, int, str]]:
        ranges = dataset.selected_steps.ranges_of(index)
        start, end = ranges[0][0], ranges[-1][1]
        count = min(_END_STEPS, (end - start + 1) // 2)
        episode = dataset.read(index)
        counts = []
        for which, first, order in (("first", start, 1), ("last", end - count, -1)):
            grey = small_grey(episode.read_frames(range(first, first + count)))[::order]
            states = episode.states[first : first + count][::order]
            counts.append((*count_at_end(grey, states, is_pose=is_pose), f"{episode.info.id}, the {which}"))
        return counts

    chosen = sample_of(dataset, affordable(dataset))
    ends = [end for _, pair in read_each(dataset, chosen, read) for end in pair]
    checked = f"up to {_END_STEPS} frames at both ends of {counted(len(ends) // 2, 'episode')} checked"
    black, frozen, example = max(ends, key=lambda end: max(end[:2]))
    if not black + frozen:
        return Finding("ok", "episode ends", f"no black or frozen frames ({checked})")
    black_frames = "frame is black" if black == 1 else f"{black} frames are black"
    kind = black_frames if black > frozen else f"{frozen} frames are one image while the robot moves"
    text = f"{sum(end[0] for end in ends):,} black and {sum(end[1] for end in ends):,} frozen frames ({checked})"
    return Finding("warning", "episode ends", f"{text}. Example: {example} {kind}. {_EXCLUDE}")


def _check_middles(dataset: Dataset) -> Finding:
    """Return the finding about episodes whose middle frame is blank, because a camera failed or images were lost."""

    def is_blank(index: int) -> bool:
        start, end = max(dataset.selected_steps.ranges_of(index), key=lambda limits: limits[1] - limits[0])
        return bool(np.ptp(small_grey(dataset.read(index).read_frames([(start + end) // 2]))) < BLANK)

    results = dict(read_each(dataset, sample_of(dataset, affordable(dataset, _MIDDLES)), is_blank))
    blank = [dataset.table.identity(index) for index, has_blank_frame in results.items() if has_blank_frame]
    text = f"the middle frame is black or uniform in {len(blank)} of {counted(len(results), 'episode')} checked"
    return first_case("blank frames", text, (bool(blank), "warning", f"{format_identities(blank)}. {_EXCLUDE}"))


def count_at_end(
    grey: Float32[np.ndarray, "steps rows columns"], states: Float[np.ndarray, "steps dim"], *, is_pose: bool
) -> tuple[int, int]:
    """Return the numbers of black frames, and of identical frames while the robot moves, at an end of an episode.

    Args:
        grey: Frames from 0 to 255, the outermost one first.
        states: The states of the frames.
        is_pose: Whether the states are poses; otherwise frozen frames are not counted.
    """
    black = _num_leading(grey.max(axis=(1, 2)) < BLANK)
    same = _num_leading(is_still(np.abs(np.diff(grey, axis=0)).mean(axis=(1, 2), dtype=np.float64))) + 1
    has_moved = is_pose and np.ptp(states[:same, POSE.position], axis=0).max() > _MOVED_M
    return black, same if has_moved and same >= _MIN_FROZEN and same > black else 0


def _num_leading(mask: Bool[np.ndarray, " steps"]) -> int:
    """Return the number of true values before the first false one."""
    return int(np.cumprod(mask).sum())
