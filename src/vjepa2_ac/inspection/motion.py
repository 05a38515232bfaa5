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
from vjepa2_ac.inspection.coverage import PERCENTILE, ReadEpisode, read_each, read_sample, select_sample
from vjepa2_ac.inspection.excerpts import BLANK, convert_to_small_grey, is_still, limit_episodes
from vjepa2_ac.inspection.findings import Finding, duplicates_finding, first_case
from vjepa2_ac.spaces import POSE, compute_step_sizes

_EPISODES = 200  # maximum number of episodes whose states are read
_MIDDLES = 64  # maximum number of episodes whose middle frame is read
_MAX_FAST = 200  # maximum number of impossibly fast episodes that are read to report their steps
# Limits for a group of episodes at another scale: minimum size, minimum separation in standard deviations, minimum
# factor, and maximum difference in shape. Measured separations: 5.8 (BridgeData) and 9.0 (simulated arm) with half of
# the episodes at half the scale, at most 4.0 otherwise.
_MIN_GROUP, _SEPARATION, _SCALE, _SAME_SHAPE = 4, 5.0, 1.4, 0.2
_END_STEPS = 16  # steps at each end of an episode whose frames are read
_MIN_FROZEN = 3  # single repeated frames come from a camera with a lower rate
_MOVED_M = 0.01  # smallest motion that is visible in an image
FASTEST_M_S, FASTEST_RAD_S = 2.5, 10.0  # speeds between control steps that no arm reaches
_FARTHER = 1.5  # zeros are padding if the step to them exceeds this multiple of the 99th percentile of all steps
_EXCLUDE = "Remove these steps from the data set, or list the episodes in data.exclude"


class Stretch(NamedTuple):
    """Consecutive control steps of an episode that are used in training."""

    name: str  # the episode's identity
    start: int  # the first step
    states: Float[np.ndarray, "steps 7"]


def check_motion(dataset: Dataset) -> Iterator[Finding]:
    """Read the states of some episodes and a few frames of fewer episodes, and yield the findings about motion.

    Raises:
        InputError: An episode cannot be read, and `data.broken_episodes` does not skip it.
    """
    if dataset.spaces.state.position is None:
        for name in ("scale", "speed", "padding", "rotation format"):
            yield Finding("skipped", name, "needs poses (data.states: pose), found vectors")
    else:
        sample = list(read_sample(dataset, limit_episodes(dataset, _EPISODES), also=_fast_episodes(dataset)))
        yield check_scale(dataset)
        yield from _check_states(dataset, sample)
        yield from _check_rotation_format(dataset, sample)
    if dataset.config.is_cache:
        yield Finding("skipped", "episode ends", "needs frames, found a latent cache. Check the original data set")
    else:
        yield _check_middles(dataset)
        yield _check_ends(dataset)


def warnings_from_index(dataset: Dataset) -> list[Finding]:
    """Return the warnings that need no frames: duplicates, groups at another scale, speed and padding.

    Only the states of episodes that are impossibly fast according to the index are read.

    Raises:
        InputError: As for `check_motion`.
    """
    findings = [duplicates_finding(dataset)]
    if dataset.config.states == "pose":
        sample = list(read_sample(dataset, 0, also=_fast_episodes(dataset)))
        findings += check_scale(dataset), *_check_states(dataset, sample)
    return [finding for finding in findings if finding.level == "warning"]


def check_scale(dataset: Dataset) -> Finding:
    """Return the finding about two groups of episodes whose positions differ in scale, as with different units."""
    radii_m, spans_m = (np.linalg.norm(dataset.table.motion[:, part], axis=1) for part in (MEANS, SPANS))
    members = dataset.episodes[(radii_m * spans_m)[dataset.episodes] > 0]  # excludes unknown motion
    if len(members) < 2 * _MIN_GROUP:
        needed = f"needs poses in the index of {2 * _MIN_GROUP} or more episodes, found {len(members)}"
        return Finding("skipped", "scale", needed)
    members = members[np.argsort(radii_m[members])]
    radii_m, directions = radii_m[members], dataset.table.motion[members, MEANS] / radii_m[members, None]
    features = np.column_stack([np.log(radii_m), directions, np.log(spans_m[members] / radii_m)])
    gaps = np.diff(features[:, 0])[_MIN_GROUP - 1 : len(members) - _MIN_GROUP]
    small, large = np.split(features, [_MIN_GROUP + int(gaps.argmax())])
    change, noise = large.mean(axis=0) - small.mean(axis=0), np.sqrt((small[:, 0].var() + large[:, 0].var()) / 2)
    compared = f"{len(members):,} of {counted(len(dataset.episodes), 'episode')} compared"
    if change[0] < max(_SEPARATION * noise, np.log(_SCALE)) or np.linalg.norm(change[1:]) > _SAME_SHAPE:
        return Finding("ok", "scale", f"no group of episodes has positions at another scale ({compared})")
    example, factor = dataset.table.identity(int(members[len(small)])), np.exp(change[0])
    text = (
        f"{counted(len(large), 'episode')}, such as {example}, have positions and motions {factor:.2f} times as large"
    )
    return Finding(
        "warning", "scale", f"{text} as the other {len(small):,} ({compared}). Check the unit of both groups"
    )


def _fast_episodes(dataset: Dataset) -> list[int]:
    """Return at most 200 episodes with a step that, by the index, is faster than any arm; the fastest first."""
    members = dataset.episodes
    excess = (dataset.table.motion[members, :2] / [FASTEST_M_S, FASTEST_RAD_S]).max(axis=1)
    order = np.argsort(-excess)[: int((excess * dataset.control_rate_hz > 1).sum())]
    return [int(index) for index in members[order[:_MAX_FAST]]]


def _check_states(dataset: Dataset, sample: Sequence[ReadEpisode]) -> Iterator[Finding]:
    """Yield the findings about speed and padding. The index contains the speed of episodes that were not read."""
    num_indexed = int((dataset.table.motion[dataset.episodes, 0] >= 0).sum())
    checked = f"{len(sample):,} of {counted(len(dataset.episodes), 'episode')} checked"
    by_index = f", {num_indexed:,} by the index" if num_indexed > len(sample) else ""
    stretches = [
        Stretch(dataset.table.identity(episode.index), start, episode.states[start:end])
        for episode in sample
        for start, end in episode.selected
        if end - start > 1
    ]
    yield check_speed(stretches, dataset.control_rate_hz, checked + by_index)
    yield check_padding(stretches, checked)


def check_speed(stretches: Sequence[Stretch], control_rate_hz: float, checked: str) -> Finding:
    """Return the finding about poses that change faster between control steps than an arm can move.

    Args:
        stretches: Stretches of some episodes.
        control_rate_hz: Control steps per second.
        checked: Text with the number of checked episodes.
    """
    if not stretches:
        return Finding("skipped", "speed", "needs episodes of two or more steps, found none")
    speeds, angular_speeds = (
        control_rate_hz * np.concatenate([compute_step_sizes(stretch.states) for stretch in stretches]).T
    )
    excess = np.maximum(speeds / FASTEST_M_S, angular_speeds / FASTEST_RAD_S)
    if excess.max() <= 1:
        text = f"at most {speeds.max():.2f} m/s and {angular_speeds.max():.2f} rad/s between control steps ({checked})"
        return Finding("ok", "speed", text)
    steps = [(stretch.name, stretch.start + step) for stretch in stretches for step in range(len(stretch.states) - 1)]
    fast, worst = np.flatnonzero(excess > 1).tolist(), int(excess.argmax())
    name, step = steps[worst]
    episodes = counted(len({steps[index][0] for index in fast}), "episode")
    limit = f"{FASTEST_M_S:g} m/s or {FASTEST_RAD_S:g} rad/s, which no arm reaches"
    text = f"faster than {limit}: {counted(len(fast), 'control step')} in {episodes} ({checked})"
    example = f"{name}, step {step} to {step + 1}: {speeds[worst]:.1f} m/s, {angular_speeds[worst]:.1f} rad/s"
    fix = "Look for padding, lost measurements and joined recordings"
    return Finding("warning", "speed", f"{text}. Example: {example}. {fix}")


def check_padding(stretches: Sequence[Stretch], checked: str) -> Finding:
    """Return the finding about poses that are exactly zero although the previous or next pose is far away.

    Poses relative to the first state of an episode also begin with zeros, but the next poses are near.
    """
    runs: list[tuple[float, str, int, int]] = []  # farthest step from or to the zeros, identity, first step, end
    other_steps_m = [np.zeros(1)]
    for name, start, states in stretches:
        is_zero = np.all(states[:, : POSE.gripper] == 0, axis=1)
        steps_m = np.linalg.norm(np.diff(states[:, POSE.position], axis=0), axis=1)
        other_steps_m.append(steps_m[~(is_zero[1:] | is_zero[:-1])])
        for first, end in np.flatnonzero(np.diff(np.pad(is_zero.astype(int), 1))).reshape(-1, 2).tolist():
            farthest_m = np.inf if end - first == len(states) else float(steps_m[max(0, first - 1) : end].max())
            runs.append((farthest_m, name, start + first, start + end))
    min_padding_m = _FARTHER * float(np.percentile(np.concatenate(other_steps_m), PERCENTILE))
    padding = [run for run in runs if run[0] > min_padding_m]
    if not padding:
        return Finding("ok", "padding", f"no padding with zeros ({checked})")
    zeros = counted(sum(end - first for *_, first, end in padding), "state")
    episodes = counted(len({name for _, name, *_ in padding}), "episode")
    _, name, first, end = max(padding, key=lambda run: run[3] - run[2])
    example = f"step {first}" if end - first == 1 else f"steps {first} to {end - 1}"
    text = f"{zeros} in {episodes} with a position and a rotation of exactly zero: padding or lost measurements"
    return Finding("warning", "padding", f"{text} ({checked}). Example: {name}, {example}. {_EXCLUDE}")


def _check_rotation_format(dataset: Dataset, sample: Sequence[ReadEpisode]) -> Iterator[Finding]:
    """Yield the finding about rotation numbers that give a smoother rotation in another format."""
    config, source, about = dataset.config, dataset.source, "rotation format"
    if config.is_cache:
        yield Finding("skipped", about, "needs recorded rotations, found a latent cache. Check the original data set")
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
        states_of_episode[start:end, POSE.rotation]
        for index, states_of_episode in states.items()
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
    num_decisive = min(map(as_configured.num_smoother_than, alternatives), default=MIN_JUMPS)
    if num_decisive < MIN_JUMPS:
        needed = f"needs at least {MIN_JUMPS} jumps of the rotation numbers (such as an angle that passes pi)"
        yield Finding("skipped", about, f"{needed} to distinguish formats, found {num_decisive}")
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
        ends = []
        for name, first, order in (("first", start, 1), ("last", end - count, -1)):
            grey = convert_to_small_grey(episode.read_frames(range(first, first + count)))[::order]
            states = episode.states[first : first + count][::order]
            ends.append((*count_at_end(grey, states, is_pose=is_pose), f"{episode.info.id}, the {name}"))
        return ends

    indices = select_sample(dataset, limit_episodes(dataset))
    ends = [end for _, both_ends in read_each(dataset, indices, read) for end in both_ends]
    checked = f"up to {_END_STEPS} frames at both ends of {counted(len(ends) // 2, 'episode')} checked"
    black, frozen, example = max(ends, key=lambda end: max(end[:2]))
    if not black + frozen:
        return Finding("ok", "episode ends", f"no black or frozen frames ({checked})")
    black_frames = "frame is black" if black == 1 else f"{black} frames are black"
    kind = black_frames if black > frozen else f"{frozen} frames are one image while the robot moves"
    text = f"{sum(end[0] for end in ends):,} black and {sum(end[1] for end in ends):,} frozen frames ({checked})"
    return Finding("warning", "episode ends", f"{text}. Example: {example} {kind}. {_EXCLUDE}")


def _check_middles(dataset: Dataset) -> Finding:
    """Return the finding about episodes whose middle frame is black or uniform, as after a failure of the camera."""

    def is_blank(index: int) -> bool:
        start, end = max(dataset.selected_steps.ranges_of(index), key=lambda limits: limits[1] - limits[0])
        return bool(np.ptp(convert_to_small_grey(dataset.read(index).read_frames([(start + end) // 2]))) < BLANK)

    results = dict(read_each(dataset, select_sample(dataset, limit_episodes(dataset, _MIDDLES)), is_blank))
    blank = [dataset.table.identity(index) for index, has_blank_middle in results.items() if has_blank_middle]
    text = f"the middle frame is black or uniform in {len(blank)} of {counted(len(results), 'episode')} checked"
    return first_case("blank frames", text, (bool(blank), "warning", f"{format_identities(blank)}. {_EXCLUDE}"))


def count_at_end(
    grey: Float32[np.ndarray, "steps rows columns"], states: Float[np.ndarray, "steps dim"], *, is_pose: bool
) -> tuple[int, int]:
    """Return the numbers of black frames, and of identical frames while the robot moves, at one end of an episode.

    Args:
        grey: Frames from 0 to 255, the outermost frame first.
        states: The states of the frames.
        is_pose: Whether the states are poses; otherwise frozen frames are not counted.
    """
    num_black = _count_leading(grey.max(axis=(1, 2)) < BLANK)
    num_identical = _count_leading(is_still(np.abs(np.diff(grey, axis=0)).mean(axis=(1, 2), dtype=np.float64))) + 1
    has_moved = is_pose and np.ptp(states[:num_identical, POSE.position], axis=0).max() > _MOVED_M
    is_frozen = has_moved and num_identical >= _MIN_FROZEN and num_identical > num_black
    return num_black, num_identical if is_frozen else 0


def _count_leading(mask: Bool[np.ndarray, " steps"]) -> int:
    """Return the number of true values before the first false one."""
    return int(np.cumprod(mask).sum())
