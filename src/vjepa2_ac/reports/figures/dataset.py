"""Content of the contact sheet: the selection of episodes, frames and metrics of a data set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.inspection.coverage import PoseCoverage
from vjepa2_ac.data.inspection.statistics import RELEASED_STEP_CM, Inspection, ReadEpisode, idle_runs
from vjepa2_ac.data.inspection.statistics_vectors import largest_change
from vjepa2_ac.data.transforms import crop_box
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.reports.figures.contact_sheet import ContactSheet, Strip, pictures_per_row, plot_contact_sheet

_PLACES = 6000  # points of the map, at most


def plot_dataset(
    dataset: Dataset, inspection: Inspection, path: Path, *, rows: int = 8, progress: Progress = no_progress
) -> Path:
    """Write the contact sheet of an inspected data set; decodes only the frames that it shows.

    `progress` is called with (episodes whose frames were read, episodes shown).

    Raises:
        InputError: A frame cannot be read, and `data.broken_episodes` does not leave its episode out.
    """
    shown = _rows_of(inspection, rows)
    names = _short_names([dataset.table.identity(one.index) for one in shown])
    strips = []
    for done, (one, name) in enumerate(zip(shown, names, strict=True), start=1):
        try:
            strips.append(_strip(dataset, inspection, one, name))
        except InputError as error:
            dataset.leave_out(one.index, error)
        progress(done, len(shown))
    return plot_contact_sheet(sheet_of(inspection, strips), path)


def sheet_of(inspection: Inspection, strips: Sequence[Strip]) -> ContactSheet:
    """Return the content of the sheet besides the strips: the title, the facts and the data of the plots."""
    config, has_poses = inspection.config, inspection.has_poses
    places = np.concatenate([one.states[:, inspection.spaces.state.sized] for one in inspection.sample])
    moved = {one.stride: one.moved_cm for one in inspection.motions}
    return ContactSheet(
        title=config.path,
        facts=_facts(inspection),
        strips=tuple(strips),
        control_rate_hz=inspection.control_rate_hz,
        lengths_s=inspection.lengths / inspection.control_rate_hz,
        moved=moved if has_poses else {one.stride: one.percent for one in inspection.changes},
        reference=RELEASED_STEP_CM if has_poses else None,
        places_m=places[:: -(-len(places) // _PLACES)] if has_poses else None,
        shaded_means=_shaded_means(config),
        ranges=None if has_poses else inspection.ranges,
        directions=inspection.coverage.density if isinstance(inspection.coverage, PoseCoverage) else None,
    )


def _facts(inspection: Inspection) -> tuple[str, ...]:
    config = inspection.config
    success = inspection.success_share
    shortest, _, median, _, longest = inspection.length_percentiles
    steps = int(inspection.lengths.sum())
    lasting = f"{inspection.hours:,.1f} h" if inspection.hours >= 1 else f"{inspection.hours * 60:.1f} min"
    first = [
        f"{len(inspection.lengths):,} episodes",
        f"{steps:,} steps at {inspection.control_rate_hz:g} per second: {lasting}",
        f"{shortest} to {longest} steps (median {median})",
        "outcome not known" if success is None else f"{success:.0%} successes",
    ]
    if inspection.still_share is not None:
        first.append(f"{inspection.still_share:.0%} of the time standing still")
    if inspection.broken:
        first.append(f"{inspection.broken} broken")
    second = [
        f"camera {', '.join(config.cameras)} of {', '.join(inspection.cameras)}",
        f"crop {config.crop}",
        _about_states(inspection),
        f"clips of {config.frames} frames at stride {config.model_stride}: "
        + ", ".join(f"{count:,} {name}" for name, count in inspection.windows_of.items()),
    ]
    sampled = len(inspection.sample)
    shown = "Motion and gripper" if inspection.has_poses else "Motion"
    third = f"{shown}: from {'all' if sampled == len(inspection.lengths) else 'a sample of'} {sampled} episodes."
    return "  ·  ".join(first), "  ·  ".join(second), third


def _shaded_means(config: DataConfig) -> str:
    if config.idle.rule != "none":
        return f"left out by data.idle ({config.idle.rule})"
    return "standing still" if config.states == "pose" else ""


def _about_states(inspection: Inspection) -> str:
    if not inspection.has_poses:
        return f"states of {inspection.widths.state} numbers, actions of {inspection.widths.action}"
    gripper = inspection.gripper_range
    return f"gripper {gripper[0]:.2f} to {gripper[1]:.2f}"


def _rows_of(inspection: Inspection, rows: int) -> list[ReadEpisode]:
    """Return episodes of the sample, some of each outcome."""
    groups = [[one for one in inspection.sample if inspection.success[one.index] == kind] for kind in (1, 0, -1)]
    groups = [group for group in groups if group]
    whole = sum(map(len, groups))
    shares = [max(1, round(rows * len(group) / whole)) for group in groups]
    shares[shares.index(max(shares))] += rows - sum(shares)
    chosen = [one for group, share in zip(groups, shares, strict=True) for one in group[: max(share, 0)]]
    return sorted(chosen, key=lambda one: inspection.sample.index(one))


def _short_names(names: Sequence[str]) -> list[str]:
    """Return names without their common leading folders; of "a--b" only a, if that is unique."""
    heads = [name.split("--")[0] for name in names]
    parts = [name.split("/") for name in (heads if len(set(heads)) == len(names) else names)]
    while len(parts) > 1 and len({part[0] for part in parts}) == 1 and min(map(len, parts)) > 1:
        parts = [part[1:] for part in parts]
    return ["/".join(part) for part in parts]


def _strip(dataset: Dataset, inspection: Inspection, one: ReadEpisode, name: str) -> Strip:
    episode = dataset.source.read(one.index)
    steps = len(one.states)
    pictured = np.arange(steps) if episode.frame_steps is None else episode.frame_steps
    height, width = episode.read_frames([int(pictured[0])]).shape[1:3]
    count = min(pictures_per_row(height, width), len(pictured))
    at = pictured[((np.arange(count) + 0.5) * len(pictured) / count).astype(np.int64)].astype(np.int64)
    return Strip(
        name=name,
        success=episode.info.success,
        frames=episode.read_frames([int(step) for step in at]),
        steps=at,
        speed=_change_per_step(one, inspection) * episode.control_rate_hz,
        closedness=one.states[:, inspection.spaces.state.gripper] if inspection.has_poses else None,
        shaded=_shaded(dataset, one),
        seen=crop_box(height, width, dataset.config.crop),
    )


def _change_per_step(one: ReadEpisode, inspection: Inspection) -> Float[np.ndarray, " steps"]:
    """Return the motion in each control step, in the sheet's unit."""
    if len(one.states) == 1:
        return np.zeros(1)
    if not inspection.has_poses:
        return largest_change(np.gradient(one.states, axis=0), inspection.ranges)
    return inspection.spaces.state.shown_size(np.gradient(one.states, axis=0))


def _shaded(dataset: Dataset, one: ReadEpisode) -> tuple[tuple[int, int], ...]:
    if dataset.config.idle.rule == "none" and dataset.config.states == "vector":
        return ()  # what standing still means is not known
    if dataset.config.idle.rule == "none":
        mask = idle_runs(one.states, dataset.config)
    else:
        mask = np.ones(len(one.states), bool)
        for start, end in one.kept:
            mask[start:end] = False
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0)).tolist()
    return tuple(zip(edges[::2], edges[1::2], strict=True))
