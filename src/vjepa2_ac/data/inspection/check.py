"""`data check`: opens a data set, loads a few batches as training would, and checks every number in them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from textwrap import shorten

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.coverage import coverage_in, find_duplicates
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.inspection.excerpts import Finding, Level, excerpt_findings
from vjepa2_ac.data.inspection.statistics import PERCENTILES, at_some_stride
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.data.sources.indexed_source import FramesByStep
from vjepa2_ac.data.splits import describe_splits, held_out_by
from vjepa2_ac.episode import Batch, Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.intervals import ENOUGH_EPISODES
from vjepa2_ac.media.video import is_same_rate
from vjepa2_ac.spaces import POSE, POSES, Spaces

_MOVED_M, _MOVED_SHARE = 0.01, 0.05  # of the flange, or of the range of a number: it should be visible
_DARK = 8  # of 255: mean of frames that show next to nothing
_STILL_CM, _FAR_CM = 0.2, 30.0  # medians of |dxyz| per model step that are reported
_REACH_M = 1.6  # beyond the reach of common arms
_LONGEST = 300  # characters of a reason
_NARROW = 0.2  # a gripper that never closes further may be given in metres
_LARGE = 100.0  # numbers of vectors beyond plausible radians, metres and shares
_NUMBERED = 8  # numbers of a vector in a message


def check_data(
    config: DataConfig, *, seed: int = 0, batch_size: int = 2, clips: int = 32, progress: Progress | None = None
) -> Iterator[Finding]:
    """Yield the findings, line by line, in the order in which training would meet them.

    An `error` means that training would learn nothing or not start; a `warning` should be looked at.

    Args:
        config: The data.
        seed: Of the order of clips.
        batch_size: Clips in a batch.
        clips: About as many are read.
        progress: Called while the index is built.

    Raises:
        InputError: The data cannot be opened, or a clip cannot be read.
    """
    started = time.perf_counter()
    dataset = open_dataset(config, progress=progress)
    config, seconds = dataset.config, time.perf_counter() - started
    steps = int(dataset.table.num_steps.sum())
    yield Finding("ok", "source", f"{config.source}, {config.path}, camera {', '.join(config.cameras)}")
    yield Finding("ok", "index", f"{len(dataset.table):,} episodes, {steps:,} steps; opened in {seconds:.1f} s")
    if config.stride == "auto":
        dataset = at_some_stride(dataset)
        yield Finding("ok", "stride", f"auto; looked at here at the smallest candidate, {dataset.config.stride}")
    yield from _what_takes_part(dataset)
    yield from _read(dataset, seed=seed, batch_size=batch_size, clips=clips)
    yield from _video_rates(dataset)
    if coverage := coverage_in(dataset):
        yield from (Finding("ok", name, text) for name, text in coverage.lines.items())
        yield Finding("warning" if coverage.narrow else "ok", "coverage", coverage.verdict)
    yield from excerpt_findings(dataset)


def _what_takes_part(dataset: Dataset) -> Iterator[Finding]:
    config = dataset.config
    for one in dataset.removed:
        if one.episodes or one.steps or one.windows:
            yield Finding("warning" if one.name == "broken" else "ok", f"filter {one.name}", f"left out: {one}")
    for problem in dataset.table.problems[:3]:
        yield Finding("warning", "broken episode", f"{problem.where}: {problem.found}")
    if splits_used := describe_splits(dataset.table, config):
        yield Finding("ok", "splits", splits_used)
    splits: dict[Split, float] = {"train": 1.0, "validation": 1.0, "test": config.test_share}
    for split, share in splits.items():
        try:
            windows = dataset.windows(split)
        except InputError as error:
            if split == "train":
                raise
            level: Level = "error" if share else "ok"  # training opens validation, and test if it has a share
            yield Finding(level, split, f"{shorten(error.found, _LONGEST, placeholder=' …')}. {error.fix}")
            continue
        episodes = len(np.unique(windows.episodes))
        short = f"; {len(windows.short):,} episodes are too short" if len(windows.short) else ""
        clip = f"clips of {config.frames} frames at stride {config.stride}"
        yield Finding("ok", split, f"{len(windows):,} {clip} in {episodes:,} episodes{short}")
    yield from _split_that_can_answer(dataset)
    if config.split_by is not None:
        groups = len(np.unique(dataset.split_hash[dataset.taking_part]))
        own = ", but for the data set's own" if held_out_by(dataset.table, config) else ""
        yield Finding("ok", "groups", f"{groups:,} by {config.split_by}, each in one split{own}")
    duplicates = find_duplicates(dataset)
    yield Finding("warning" if duplicates.episodes else "ok", "duplicates", str(duplicates))


def _split_that_can_answer(dataset: Dataset) -> Iterator[Finding]:
    """Say where the test split has too few episodes to know whether training helped, and which share has enough."""
    config, among = dataset.config, dataset.table.num_steps >= dataset.config.clip_steps
    count = int((dataset.members("test") & among).sum())
    if not 0 < count < ENOUGH_EPISODES:
        return
    words = f"{count} episode{'s' * (count != 1)} cannot tell whether training helped, {ENOUGH_EPISODES} would"
    if "test" in held_out_by(dataset.table, config):
        yield Finding("warning", "test", f"{words}. data.splits=hash draws the test split from all episodes")
        return
    for percent in range(5, 55, 5):
        other = replace(dataset, config=config.model_copy(update={"test_share": percent / 100}))
        test, train = (int((other.members(split) & among).sum()) for split in ("test", "train"))
        if test >= ENOUGH_EPISODES and train > test:
            yield Finding("warning", "test", f"{words}: with data.test_share={percent / 100:g} it has {test}")
            return
    whole = int((dataset.taking_part & among).sum())
    yield Finding("warning", "test", f"{words}: no share of {whole} leaves enough to train on. Record more")


def _video_rates(dataset: Dataset) -> Iterator[Finding]:
    """Yield a finding for each camera whose videos have another rate than the steps, by the first episode's header."""
    first = int(dataset.taking_part.argmax())
    for camera in dataset.config.cameras:
        with suppress(InputError):  # a damaged video is reported where a clip needs it
            frames = dataset.source.read(first, camera).read_frames
            rates_hz = frames.rates_hz() if isinstance(frames, FramesByStep) and frames.rates_hz else (0.0, 0.0)
            if not is_same_rate(*rates_hz):
                text = f"{camera}: videos have {rates_hz[0]:.4g} frames a second, steps {rates_hz[1]:g}"
                yield Finding("ok", "video rate", f"{text}; a step has the frame nearest in time")


def _read(dataset: Dataset, *, seed: int, batch_size: int, clips: int) -> Iterator[Finding]:
    started = time.perf_counter()
    loader = training_loader(dataset, seed=seed, batch_size=batch_size)
    batches = [next(loader)]
    first_s = time.perf_counter() - started
    batches += islice(loader, max(1, -(-clips // batch_size) - 1))
    rest_s = time.perf_counter() - started - first_s
    read = [batch for batch in batches if batch.starts]
    if not read:
        yield Finding("error", "clips", f"none of {len(batches) * batch_size} could be read: see data.broken_episodes")
        return
    yield from findings_in(read, dataset.spaces)
    rate = sum(len(batch.starts) for batch in batches[1:]) / max(rest_s, 1e-9)
    speed = f"first batch of {batch_size} after {first_s:.2f} s, then {rate:.1f} clips/s"
    yield Finding("ok", "timing", f"{speed} with {dataset.config.workers} workers")
    if storage.is_url(dataset.config.path):
        fetched = sum(batch.bytes_fetched for batch in batches)
        count = sum(len(batch.starts) for batch in read)
        yield Finding("ok", "network", f"{fetched / count / 1e3:,.0f} kB fetched per clip, over {count} clips")


def findings_in(batches: Sequence[Batch], spaces: Spaces = POSES) -> Iterator[Finding]:
    """Yield the findings of some batches, with or without poses; a pure function, reads nothing."""
    first = batches[0]
    name, seen = ("latents", first.latents.values) if first.latents else ("frames", first.frames)
    shapes = f"{name} {tuple(seen.shape)} {str(seen.dtype).removeprefix('torch.')}" if seen is not None else name
    poses = "no camera poses" if first.extrinsics is None else f"camera poses {tuple(first.extrinsics.shape)}"
    text = f"{shapes}, states {tuple(first.states.shape)}, actions {tuple(first.actions.shape)}, {poses}"
    yield Finding("ok", "batch", text)
    states = np.concatenate([batch.states.flatten(0, 1).numpy() for batch in batches]).astype(np.float64)
    actions = np.concatenate([batch.actions.flatten(0, 1).numpy() for batch in batches]).astype(np.float64)
    if first.latents is None:
        yield from _in_frames(batches, spaces, np.maximum(np.ptp(states, axis=0), 1e-12))
    if spaces.state.position is None:
        yield _numbers("states", states, "Check which fields the state is made of")
        yield _numbers("actions", actions, "There is nothing to learn from")
        return
    yield from _in_poses(states, actions, sum(len(batch.starts) for batch in batches))


def _in_frames(batches: Sequence[Batch], spaces: Spaces, spans: Float[np.ndarray, " state_dim"]) -> Iterator[Finding]:
    """Yield what is wrong with the frames; those where the robot has moved are compared with the ones before them."""
    low, high, means, same, moved = 255, 0, [], 0, 0
    for batch in batches:
        if batch.frames is None:
            continue
        low, high = min(low, int(batch.frames.min())), max(high, int(batch.frames.max()))
        means.append(batch.frames.float().mean().item())
        if spaces.state.position is None:
            far = (abs(np.diff(batch.states.numpy(), axis=1)) > _MOVED_SHARE * spans).any(axis=-1)
        else:
            far = np.linalg.norm(batch.actions[..., spaces.action.sized].numpy(), axis=-1) > _MOVED_M
        equal = (batch.frames[:, 1:] == batch.frames[:, :-1]).flatten(2).all(dim=-1).numpy()
        moved += int(far.sum())
        same += int((far & equal).sum())
    mean = float(np.mean(means))
    yield _first(
        "pixels",
        f"{low} to {high}, mean {mean:.0f}",
        (low == high, "error", f"all are {low}: there is nothing to see. Check data.camera"),
        (mean < _DARK, "warning", "the frames are nearly black. Check data.camera"),
    )
    yield _first(
        "pictures",
        f"{same} of {moved} frames equal the one before although the robot moved",
        (same > moved / 2, "error", "they do not show it. Check data.camera and the control rate"),
        (same > moved / 20, "warning", "check the control rate"),
    )


def _numbers(name: str, values: Float[np.ndarray, "rows width"], way_out: str) -> Finding:
    """Return the finding about numbers of unknown meaning."""
    low, high = values.min(axis=0), values.max(axis=0)
    fixed, large = low == high, abs(values).max(axis=0) > _LARGE
    why = f"large are {_numbered(large)} (from 0). Numbers go into the network as they are"
    return _first(
        name,
        f"{values.shape[1]} numbers, {low.min():.3g} to {high.max():.3g}",
        (fixed.all(), "error", f"none of them ever changes. {way_out}"),
        (large.any(), "warning", f"{why}: bring them to the order of 1, such as radians, metres, or 0 to 1"),
        (fixed.any(), "warning", f"{_numbered(fixed)} (from 0) never change"),
    )


def _numbered(mask: np.ndarray) -> str:
    places = np.flatnonzero(mask).tolist()
    return ", ".join(map(str, places[:_NUMBERED])) + (", ..." if len(places) > _NUMBERED else "")


def _first(about: str, text: str, *cases: tuple[bool, Level, str]) -> Finding:
    """Return the finding of the first case that holds, or that all is well."""
    level, words = next(((level, words) for holds, level, words in cases if holds), ("ok", ""))
    return Finding(level, about, f"{text}: {words}" if words else text)


def _in_poses(
    states: Float[np.ndarray, "rows 7"], actions: Float[np.ndarray, "pairs 7"], clips: int
) -> Iterator[Finding]:
    """Yield a finding for each kind of number in poses."""
    places, angles, closed = states[:, POSE.position], states[:, POSE.rotation], states[:, POSE.gripper]
    low, high = places.min(axis=0), places.max(axis=0)
    wide, reach = (high - low).max(), np.linalg.norm(places, axis=1).max()
    yield _first(
        "position",
        ", ".join(f"{axis} {a:.3f} to {b:.3f}" for axis, a, b in zip("xyz", low, high, strict=True)) + " m",
        (wide == 0, "error", "it never changes. Check which fields the state is made of"),
        (reach > _REACH_M, "warning", "farther than most arms reach. Is it metres, from the base?"),
        (wide < 0.01, "warning", "all within 1 cm. Is it metres?"),
    )
    turned = np.rad2deg(Rotation.from_euler("xyz", actions[:, POSE.rotation]).magnitude())
    yield _first(
        "rotation",
        f"angles {angles.min():.2f} to {angles.max():.2f} rad; degrees per model step {_percentiles(turned, '.1f')}",
        (turned.max() == 0, "warning", "it never changes. Is it in the state?"),
        (np.percentile(turned, 90) > 90, "warning", "wild. Are these extrinsic xyz Euler angles in radians?"),
    )
    yield _first(
        "gripper",
        f"{closed.min():.2f} to {closed.max():.2f} (0 open, 1 closed)",
        (np.ptp(closed) == 0, "warning", f"it never moves in {clips} clips. Is it in the state?"),
        (closed.max() < _NARROW, "warning", "it never closes. Is it a width in metres? 0..1 is needed"),
    )
    moved = POSE.shown_size(actions)
    yield _first(
        "actions",
        f"cm per model step {_percentiles(moved, '.2f')}",
        (not np.any(actions), "error", "all are zero; there is nothing to learn from"),
        (np.median(moved) < _STILL_CM, "warning", "nearly still. See data.idle, or a wider data.stride"),
        (np.median(moved) > _FAR_CM, "warning", "very far. Is it metres? Is data.stride too wide?"),
    )


def _percentiles(values: Float[np.ndarray, " pairs"], form: str) -> str:
    numbers = " / ".join(f"{value:{form}}" for value in np.percentile(values, list(PERCENTILES)))
    return f"{numbers} (10/50/90/99 %)"
