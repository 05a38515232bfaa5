"""Content of the contact sheet: the selection of episodes, frames and metrics of a data set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.coverage import ReadEpisode
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.idle import runs_of
from vjepa2_ac.data.inspection.statistics import CHANGED, MOVED, RELEASED_STEP_CM, Inspection, idle_runs, largest_change
from vjepa2_ac.data.transforms import crop_box
from vjepa2_ac.episode import Progress, no_progress, short_names
from vjepa2_ac.errors import InputError
from vjepa2_ac.reports.figures.contact_sheet import ContactSheet, Strip, pictures_per_row, plot_contact_sheet

_PLACES = 6000  # points of the map, at most
_FACTS = (
    ("episodes", "steps", "length", "success"),
    ("cameras", "gripper", "states", "left out"),
    ("splits", "standing still", "sample"),
)  # of the summary, line by line


def plot_dataset(inspection: Inspection, path: Path, *, rows: int = 8, progress: Progress = no_progress) -> Path:
    """Write the contact sheet of an inspected data set; decodes only the frames that it shows.

    `progress` is called with (episodes whose frames were read, episodes shown).

    Raises:
        InputError: A frame cannot be read, and `data.broken_episodes` does not leave its episode out.
    """
    dataset, shown = inspection.dataset, _rows_of(inspection, rows)
    identities = [dataset.table.identity(one.index) for one in shown]
    names = short_names(identities)
    strips = []
    for done, (one, name) in enumerate(zip(shown, identities, strict=True), start=1):
        try:
            strips.append(_strip(inspection, one, names[name]))
        except InputError as error:
            dataset.leave_out(one.index, error)
        progress(done, len(shown))
    return plot_contact_sheet(sheet_of(inspection, strips), path)


def sheet_of(inspection: Inspection, strips: Sequence[Strip]) -> ContactSheet:
    """Return the content of the sheet besides the strips: the title, the facts and the data of the plots."""
    dataset, has_poses, coverage = inspection.dataset, inspection.has_poses, inspection.coverage
    summary = inspection.summary
    places = np.concatenate([one.states[:, dataset.spaces.state.sized] for one in inspection.sample])
    return ContactSheet(
        title=dataset.config.path,
        facts=tuple("  ·  ".join(f"{name}: {summary[name]}" for name in line if name in summary) for line in _FACTS),
        strips=tuple(strips),
        control_rate_hz=dataset.control_rate_hz,
        lengths_s=dataset.table.num_steps / dataset.control_rate_hz,
        moved={one.stride: one.sizes[MOVED if has_poses else CHANGED] for one in inspection.steps},
        reference=RELEASED_STEP_CM if has_poses else None,
        places_m=places[:: -(-len(places) // _PLACES)] if has_poses else None,
        shaded_means=_shaded_means(dataset.config),
        ranges=None if has_poses else inspection.ranges,
        directions=None if coverage is None else coverage.density,
    )


def _shaded_means(config: DataConfig) -> str:
    if config.idle.rule != "none":
        return f"left out by data.idle ({config.idle.rule})"
    return "standing still" if config.states == "pose" else ""


def _rows_of(inspection: Inspection, rows: int) -> list[ReadEpisode]:
    """Return episodes of the sample, some of each outcome."""
    groups = [
        [one for one in inspection.sample if inspection.dataset.table.success[one.index] == kind] for kind in (1, 0, -1)
    ]
    groups = [group for group in groups if group]
    whole = sum(map(len, groups))
    shares = [max(1, round(rows * len(group) / whole)) for group in groups]
    shares[shares.index(max(shares))] += rows - sum(shares)
    chosen = [one for group, share in zip(groups, shares, strict=True) for one in group[: max(share, 0)]]
    return sorted(chosen, key=lambda one: inspection.sample.index(one))


def _strip(inspection: Inspection, one: ReadEpisode, name: str) -> Strip:
    dataset = inspection.dataset
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
        closedness=one.states[:, dataset.spaces.state.gripper] if inspection.has_poses else None,
        shaded=_shaded(dataset, one),
        seen=crop_box(height, width, dataset.config.crop),
    )


def _change_per_step(one: ReadEpisode, inspection: Inspection) -> Float[np.ndarray, " steps"]:
    """Return the motion in each control step, in the sheet's unit."""
    if len(one.states) == 1:
        return np.zeros(1)
    if not inspection.has_poses:
        return largest_change(np.gradient(one.states, axis=0), inspection.ranges)
    return inspection.dataset.spaces.state.shown_size(np.gradient(one.states, axis=0))


def _shaded(dataset: Dataset, one: ReadEpisode) -> tuple[tuple[int, int], ...]:
    if dataset.config.idle.rule != "none":
        left_out = np.ones(len(one.states), bool)
        for start, end in one.kept:
            left_out[start:end] = False
        return tuple(runs_of(left_out))
    if dataset.config.states == "vector":
        return ()  # what standing still means is not known
    return tuple(runs_of(idle_runs(one.states, dataset.config)))
