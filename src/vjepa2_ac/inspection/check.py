"""Check a data set (`data check`): open it, load a few batches as in training, and check the values."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from textwrap import shorten

import numpy as np
from jaxtyping import Float

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.data.selection import describe_splits, held_out_splits
from vjepa2_ac.episode import Batch, Progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.inspection.coverage import coverage_findings, measure_coverage
from vjepa2_ac.inspection.excerpts import check_excerpts
from vjepa2_ac.inspection.findings import Finding, Level, duplicates_finding, first_case
from vjepa2_ac.inspection.motion import check_motion
from vjepa2_ac.inspection.statistics import PERCENTILES, with_numeric_stride
from vjepa2_ac.intervals import MIN_EPISODES
from vjepa2_ac.spaces import POSE, POSES, Spaces, rotation_angles

_DARK = 8  # frames with a lower mean (0 to 255) are nearly black
_STILL_CM, _FAR_CM = 0.2, 30.0  # plausible medians of the motion per model step
_REACH_M = 1.6  # larger distances are beyond the reach of common arms
_MAX_REASON = 300  # maximum number of characters of a reason in a message
_OPEN = 0.2  # if the gripper position never exceeds this, the values may be widths in metres
_LARGE = 100.0  # larger values in vectors are implausible for radians, metres and fractions
_MAX_LISTED = 8  # maximum number of indices in a message


def check_data(
    config: DataConfig, *, seed: int = 0, batch_size: int = 2, clips: int = 32, progress: Progress | None = None
) -> Iterator[Finding]:
    """Check a data set and yield the findings, in the order in which training uses the data.

    Args:
        config: The data config.
        seed: Seed of the order of clips.
        batch_size: Clips in a batch.
        clips: The approximate number of clips to read.
        progress: Called while the index is built.

    Raises:
        InputError: The data cannot be opened, or a clip cannot be read.
    """
    started = time.perf_counter()
    dataset = open_dataset(config, progress=progress)
    config, seconds = dataset.config, time.perf_counter() - started
    size = f"{counted(len(dataset.table), 'episode')}, {counted(int(dataset.table.num_steps.sum()), 'step')}"
    yield Finding("ok", "source", f"{config.source} data at {config.path}, camera {', '.join(config.cameras)}")
    yield Finding("ok", "index", f"{size} (opened in {seconds:.1f} s)")
    if config.stride == "auto":
        dataset = with_numeric_stride(dataset)
        yield Finding("ok", "stride", f"auto; the checks use the smallest candidate, {dataset.config.stride}")
    yield from _check_selection(dataset)
    yield from _check_clips(dataset, seed=seed, batch_size=batch_size, clips=clips)
    yield from check_motion(dataset)
    yield from coverage_findings(measure_coverage(dataset))
    yield from check_excerpts(dataset)


def _check_selection(dataset: Dataset) -> Iterator[Finding]:
    """Yield the findings about filters, broken episodes, splits, groups and duplicated episodes."""
    config = dataset.config
    for removal in dataset.removed:
        if removal.episodes or removal.steps or removal.windows:
            level: Level = "warning" if removal.name == "broken" else "ok"
            yield Finding(level, f"filter {removal.name}", f"removes {removal}")
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
            level = "error" if share else "skipped"  # an empty test split is allowed if data.test_share is 0
            yield Finding(level, split, f"{shorten(error.found, _MAX_REASON, placeholder=' …')}. {error.fix}")
            continue
        short = f"; {counted(len(windows.short), 'episode')} shorter than a clip" if len(windows.short) else ""
        clips = f"{counted(len(windows), 'clip')} of {config.frames} frames at stride {config.stride}"
        yield Finding("ok", split, f"{clips} in {counted(len(np.unique(windows.episodes)), 'episode')}{short}")
    yield from _check_test_split(dataset)
    if config.split_by is not None:
        groups = len(np.unique(dataset.split_hash[dataset.is_selected]))
        exception = ", except for the splits of the data set" if held_out_splits(dataset.table, config) else ""
        yield Finding("ok", "groups", f"{groups:,} groups by {config.split_by}; each is in one split{exception}")
    yield duplicates_finding(dataset)


def _check_test_split(dataset: Dataset) -> Iterator[Finding]:
    """Yield a warning if the test split is too small for intervals, with a `data.test_share` that suffices."""
    config, is_long_enough = dataset.config, dataset.table.num_steps >= dataset.config.clip_steps
    count = int((dataset.split_mask("test") & is_long_enough).sum())
    if not 0 < count < MIN_EPISODES:
        return
    text = f"{counted(count, 'test episode')} cannot show whether training helped; {MIN_EPISODES} are needed"
    if "test" in held_out_splits(dataset.table, config):
        yield Finding("warning", "test", f"{text}. data.splits=hash draws the test split from all episodes")
        return
    fix = "Record more episodes"
    # Shares are tried, because the split is drawn by hashes: its size differs from its share.
    for percent in range(5, 55, 5):
        changed = replace(dataset, config=config.model_copy(update={"test_share": percent / 100}))
        test, train = (int((changed.split_mask(split) & is_long_enough).sum()) for split in ("test", "train"))
        if test >= MIN_EPISODES and train > test:
            fix = f"Set data.test_share={percent / 100:g}: the split then has {test}"
            break
    yield Finding("warning", "test", f"{text}. {fix}")


def _check_clips(dataset: Dataset, *, seed: int, batch_size: int, clips: int) -> Iterator[Finding]:
    started = time.perf_counter()
    loader = training_loader(dataset, seed=seed, batch_size=batch_size)
    batches = [next(loader)]
    first_s = time.perf_counter() - started
    batches += islice(loader, max(1, -(-clips // batch_size) - 1))
    rest_s = time.perf_counter() - started - first_s
    read = [batch for batch in batches if batch.starts]
    if not read:
        yield Finding(
            "error", "clips", f"none of {len(batches) * batch_size} clips can be read. See data.broken_episodes"
        )
        return
    yield from batch_findings(read, dataset.spaces)
    rate = sum(len(batch.starts) for batch in batches[1:]) / max(rest_s, 1e-9)
    speed = f"the first batch of {counted(batch_size, 'clip')} took {first_s:.2f} s, the next ones {rate:.1f} clips/s"
    yield Finding("ok", "timing", f"{speed} with {counted(dataset.config.workers, 'loader process')}")
    if storage.is_url(dataset.config.path):
        fetched = sum(batch.bytes_fetched for batch in batches)
        count = sum(len(batch.starts) for batch in read)
        text = f"{fetched / count / 1e3:,.0f} kB fetched per clip (mean of {counted(count, 'clip')})"
        yield Finding("ok", "network", text)


def batch_findings(batches: Sequence[Batch], spaces: Spaces = POSES) -> Iterator[Finding]:
    """Yield the findings about the values of some batches, whose states are poses or vectors."""
    first = batches[0]
    name, images = ("latents", first.latents.values) if first.latents else ("frames", first.frames)
    shapes = f"{name} {tuple(images.shape)} {str(images.dtype).removeprefix('torch.')}" if images is not None else name
    camera = "no camera poses" if first.extrinsics is None else f"camera poses {tuple(first.extrinsics.shape)}"
    text = f"{shapes}, states {tuple(first.states.shape)}, actions {tuple(first.actions.shape)}, {camera}"
    yield Finding("ok", "batch", text)
    states = np.concatenate([batch.states.flatten(0, 1).numpy() for batch in batches]).astype(np.float64)
    actions = np.concatenate([batch.actions.flatten(0, 1).numpy() for batch in batches]).astype(np.float64)
    if first.latents is None:
        yield _pixel_finding(batches)
    else:
        yield Finding("skipped", "frames", "needs frames, found a latent cache. Check the original data set")
    if spaces.state.position is None:
        yield _vector_finding("states", states, "Check which fields the state consists of")
        yield _vector_finding("actions", actions, "There is nothing to learn from")
        return
    yield from _pose_findings(states, actions, sum(len(batch.starts) for batch in batches))


def _pixel_finding(batches: Sequence[Batch]) -> Finding:
    """Return the finding about uniform or dark frames."""
    frames = [batch.frames for batch in batches if batch.frames is not None]
    low, high = min(int(batch.min()) for batch in frames), max(int(batch.max()) for batch in frames)
    mean = float(np.mean([batch.float().mean().item() for batch in frames]))
    return first_case(
        "pixels",
        f"values {low} to {high}, mean {mean:.0f}",
        (low == high, "error", f"all pixels are {low}, so the frames show nothing. Check data.camera"),
        (mean < _DARK, "warning", "the frames are nearly black. Check data.camera"),
    )


def _vector_finding(name: str, values: Float[np.ndarray, "rows width"], fix: str) -> Finding:
    """Return the finding about the numbers of states or actions that are vectors."""
    low, high = values.min(axis=0), values.max(axis=0)
    is_constant, is_large = low == high, abs(values).max(axis=0) > _LARGE
    return first_case(
        name,
        f"{values.shape[1]} numbers, {low.min():.3g} to {high.max():.3g}",
        (is_constant.all(), "error", f"none of the numbers ever changes. {fix}"),
        (
            is_large.any(),
            "warning",
            f"numbers {_list_indices(is_large)} (from 0) are large. Scale them to the order of 1",
        ),
        (is_constant.any(), "warning", f"numbers {_list_indices(is_constant)} (from 0) never change"),
    )


def _list_indices(mask: np.ndarray) -> str:
    indices = np.flatnonzero(mask).tolist()
    return ", ".join(map(str, indices[:_MAX_LISTED])) + (", ..." if len(indices) > _MAX_LISTED else "")


def _pose_findings(
    states: Float[np.ndarray, "rows 7"], actions: Float[np.ndarray, "pairs 7"], clips: int
) -> Iterator[Finding]:
    """Yield the findings about position, rotation, gripper and actions."""
    positions, angles, gripper_position = states[:, POSE.position], states[:, POSE.rotation], states[:, POSE.gripper]
    low, high = positions.min(axis=0), positions.max(axis=0)
    extent, reach = (high - low).max(), np.linalg.norm(positions, axis=1).max()
    too_far = f"positions are up to {reach:.2f} m from the base, beyond the reach of most arms ({_REACH_M:g} m)"
    yield first_case(
        "position",
        ", ".join(f"{axis} {a:.3f} to {b:.3f}" for axis, a, b in zip("xyz", low, high, strict=True)) + " m",
        (extent == 0, "error", "the position never changes. Check which fields the state consists of"),
        (reach > _REACH_M, "warning", f"{too_far}. Check that they are in metres, from the base"),
        (extent < 0.01, "warning", "all positions are within 1 cm. Check that they are in metres"),
    )
    turned_degrees = np.rad2deg(rotation_angles(actions[:, POSE.rotation]))
    percentiles = _format_percentiles(turned_degrees, ".1f", "degrees")
    yield first_case(
        "rotation",
        f"angles {angles.min():.2f} to {angles.max():.2f} rad; rotation per model step (percentiles): {percentiles}",
        (turned_degrees.max() == 0, "warning", "the rotation never changes. Check that the state contains it"),
        (
            np.percentile(turned_degrees, 90) > 90,
            "warning",
            "the rotation jumps. Check that angles are extrinsic xyz radians",
        ),
    )
    yield first_case(
        "gripper",
        f"{gripper_position.min():.2f} to {gripper_position.max():.2f} (0 open, 1 closed)",
        (
            np.ptp(gripper_position) == 0,
            "warning",
            f"the gripper never moves in {counted(clips, 'clip')}. Check that the state contains it",
        ),
        (
            gripper_position.max() < _OPEN,
            "warning",
            "the gripper never closes. Check that it is 0 to 1, not a width in metres",
        ),
    )
    moved_cm = POSE.compute_display_size(actions)
    yield first_case(
        "actions",
        f"motion per model step (percentiles): {_format_percentiles(moved_cm, '.2f', 'cm')}",
        (not np.any(actions), "error", "all actions are zero. There is nothing to learn from"),
        (np.median(moved_cm) < _STILL_CM, "warning", "the robot is nearly still. See data.idle, or raise data.stride"),
        (np.median(moved_cm) > _FAR_CM, "warning", "the steps are long. Check the unit (metres), or lower data.stride"),
    )


def _format_percentiles(values: Float[np.ndarray, " pairs"], form: str, unit: str) -> str:
    numbers = np.percentile(values, list(PERCENTILES))
    return ", ".join(f"{value:{form}} {unit} ({at} %)" for value, at in zip(numbers, PERCENTILES, strict=True))
