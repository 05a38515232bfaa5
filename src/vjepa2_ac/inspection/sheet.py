"""The contact sheet of a data set: plots of the whole data set, and image strips of episodes with their motion."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.patches import Patch, Rectangle

from vjepa2_ac.data.idle import find_runs
from vjepa2_ac.data.transforms import CropBox, crop_box
from vjepa2_ac.episode import Progress, no_progress, shorten_names
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.inspection.coverage import ENOUGH_NEAR, ReadEpisode
from vjepa2_ac.inspection.statistics import CHANGED, MOVED, RELEASED_STEP_CM, Inspection, largest_change
from vjepa2_ac.media.figure import BLUE, GREEN, GREY, ORANGE, save_figure

_PLACES = 6000  # largest number of points in the map
_IDLE = "#c9c9c9"
_OUTCOME = {True: ("success", GREEN), False: ("failure", "#c0392b"), None: ("", "#b5b5b5")}
_STRIDES = ("#7fb3dd", BLUE, "#0b3558", "#7a4fa3", "#333333")

_WIDTH, _LABEL, _FILM, _TITLE, _ROW, _PANELS = 11.0, 1.6, 9.0, 0.5, 1.6, 2.5  # inches
_EDGE = 0.2 / _WIDTH  # left and right margin, relative to the width
_LEAST, _MOST, _PICTURE = 4, 14, 0.8  # least and most images in a row, and their height in inches


@dataclass(frozen=True, eq=False)
class Strip:
    """One row of the sheet: some frames of an episode, and its motion at every control step."""

    name: str
    success: bool | None
    frames: UInt8[np.ndarray, "time height width 3"]
    speed: Float[np.ndarray, " steps"]  # cm/s of the flange; for vectors see `plot_contact_sheet`
    closedness: Float[np.ndarray, " steps"] | None  # None: the states are not poses
    shaded: tuple[tuple[int, int], ...]  # ranges [start, end) of steps that are not used
    seen: CropBox  # part of the image that is the model's input


def plot_dataset(inspection: Inspection, path: Path, *, rows: int = 8, progress: Progress = no_progress) -> Path:
    """Write the contact sheet of an inspected data set. Only the frames that it shows are decoded.

    `progress` is called with (episodes whose frames were read, episodes shown).

    Raises:
        InputError: A frame cannot be read, and `data.broken_episodes` does not leave its episode out.
    """
    dataset, shown = inspection.dataset, inspection.sample[:rows]
    identities = [dataset.table.identity(one.index) for one in shown]
    names = shorten_names(identities)
    strips = []
    for done, (one, name) in enumerate(zip(shown, identities, strict=True), start=1):
        try:
            strips.append(_strip_of(inspection, one, names[name]))
        except InputError as error:
            dataset.skip_episode(one.index, error)
        progress(done, len(shown))
    return plot_contact_sheet(inspection, strips, path)


def _strip_of(inspection: Inspection, one: ReadEpisode, name: str) -> Strip:
    dataset = inspection.dataset
    episode = dataset.source.read(one.index)
    steps = len(one.states)
    pictured = np.arange(steps) if episode.frame_steps is None else episode.frame_steps
    height, width = episode.read_frames([int(pictured[0])]).shape[1:3]
    count = min(pictures_per_row(height, width), len(pictured))
    at = pictured[((np.arange(count) + 0.5) * len(pictured) / count).astype(np.int64)].astype(np.int64)
    changes = np.gradient(one.states, axis=0) if steps > 1 else np.zeros_like(one.states)
    is_pose, space = inspection.has_poses, dataset.spaces.state
    left_out = np.ones(steps, bool)
    for start, end in one.kept:
        left_out[start:end] = False
    changed = space.compute_display_size(changes) if is_pose else largest_change(changes, inspection.ranges)
    return Strip(
        name=name,
        success=episode.info.success,
        frames=episode.read_frames([int(step) for step in at]),
        speed=changed * episode.control_rate_hz,
        closedness=one.states[:, space.gripper] if is_pose else None,
        shaded=tuple(find_runs(left_out)),
        seen=crop_box(height, width, dataset.config.crop),
    )


# ---- drawing ----


def pictures_per_row(height: int, width: int) -> int:
    """Return the number of images of a size in a row of the sheet."""
    return int(min(max(_FILM // (_PICTURE * width / height + 0.06), _LEAST), _MOST))


def plot_contact_sheet(inspection: Inspection, strips: Sequence[Strip], path: Path) -> Path:
    """Write the contact sheet of a data set as PNG, atomically.

    Motion is shown in cm of the flange for poses. For vectors it is the largest change of a number, as a percentage of
    its range, and the map of positions is replaced by the ranges of all numbers.
    """
    dataset, heights = inspection.dataset, [_TITLE, _PANELS, *(_ROW for _ in strips)]
    with save_figure(path, _WIDTH, sum(heights), dpi=130, layout="none", facecolor="white") as figure:
        title, panels, *rows = figure.subfigures(len(heights), 1, height_ratios=heights)
        title.text(_EDGE, 0.5, dataset.config.path, size=13, weight="bold", va="center")
        _panels(panels, inspection)
        speeds = np.concatenate([strip.speed for strip in strips]) if strips else np.zeros(1)
        fastest = max(float(np.percentile(speeds, 99.5)) * 1.15, 1.0)
        for part, strip in zip(rows, strips, strict=True):
            _strip(part, strip, dataset.control_rate_hz, fastest)
    return path


def _panels(part: Any, inspection: Inspection) -> None:
    """Draw the plots of the whole data set: lengths, motion per model step, positions and directions."""
    dataset, has_poses = inspection.dataset, inspection.has_poses
    lengths_s = dataset.table.num_steps / dataset.control_rate_hz
    edges = {"left": 0.04, "right": 0.96, "bottom": 0.34, "top": 0.9}
    grid = part.add_gridspec(1, 4, **edges, wspace=0.28, width_ratios=(2.0, 4.2, 3.4, 3.0))
    lengths = part.add_subplot(grid[0])
    lengths.hist(lengths_s, bins=min(40, max(5, len(lengths_s) // 2)), color=GREY)
    lengths.set_title("Episodes by length (s)")
    lengths.locator_params(axis="y", nbins=4, integer=True)
    _motion(part.add_subplot(grid[1]), inspection)
    if has_poses:
        places = np.concatenate([one.states[:, dataset.spaces.state.size_axes] for one in inspection.sample])
        places = places[:: -(-len(places) // _PLACES)]
        axes = part.add_subplot(grid[2])
        shown = axes.scatter(-places[:, 1], places[:, 0], c=places[:, 2], s=2, cmap="viridis", linewidths=0)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(title="Flange, from above (m)")
        axes.set(xlabel="-y: to the robot's right", ylabel="x: forward")
        axes.locator_params(nbins=5)
        part.colorbar(shown, ax=axes, fraction=0.04, pad=0.02)
    if (coverage := inspection.coverage) is not None and coverage.density is not None:
        _directions(part, part.add_subplot(grid[3]), coverage.density)
    if not has_poses:
        axes, ranges = part.add_subplot(grid[2:]), inspection.ranges
        axes.bar(np.arange(len(ranges)), ranges[:, 1] - ranges[:, 0], bottom=ranges[:, 0], color=BLUE)
        axes.set(title="Range of each number of the state", xlabel="number, from 0")
        axes.locator_params(axis="x", integer=True)
    speed = "speed (cm/s)" if has_poses else "fastest number (% of its range per second)"
    meanings = {speed: BLUE} | ({"gripper: 0 open, 1 closed": ORANGE} if has_poses else {}) | {"left out": _IDLE}
    meanings["bright part of a picture: what the model sees"] = "none"
    handles = [Patch(color=colour, label=label) for label, colour in meanings.items()]
    part.legend(handles=handles, loc="lower right", ncols=4, fontsize=9, handlelength=1)


def _directions(part: Any, axes: Any, directions: Float[np.ndarray, "rows columns"]) -> None:
    """Draw the density of directions as an equal-area map of the sphere, with x (forward) in the middle and z up."""
    extent = (-180.0, 180.0, -1.0, 1.0)
    shown = axes.imshow(directions, extent=extent, origin="lower", aspect="auto", cmap="Blues", vmin=0, vmax=2)
    axes.set_title(f"Directions: {(directions >= ENOUGH_NEAR).mean():.0%} covered")
    axes.set_xticks([-180, -90, 0, 90, 180], ["-x", "-y", "+x", "+y", "-x"])
    axes.set_yticks([-1, 0, 1], ["-z", "", "+z"])
    part.colorbar(shown, ax=axes, fraction=0.04, pad=0.02, ticks=[0, ENOUGH_NEAR, 1, 2])


def _motion(axes: Any, inspection: Inspection) -> None:
    has_poses, rate_hz = inspection.has_poses, inspection.dataset.control_rate_hz
    unit, reference = ("cm", RELEASED_STEP_CM) if has_poses else ("%", 1.0)
    by_stride = {stride: sizes[MOVED if has_poses else CHANGED] for stride, sizes in inspection.steps.items()}
    far = max([reference * 1.3, *(float(np.percentile(moved, 97)) for moved in by_stride.values() if len(moved))])
    reached = np.linspace(0, far, 200)
    for (stride, moved), colour in zip(by_stride.items(), _STRIDES, strict=False):
        if not len(moved):
            continue
        share = np.searchsorted(np.sort(moved), reached, side="right") / len(moved) * 100
        label = f"stride {stride} ({stride / rate_hz:.2f} s): median {np.median(moved):.1f} {unit}"
        axes.plot(reached, share, color=colour, linewidth=1.5, label=label)
    if has_poses:
        axes.axvline(reference, color=ORANGE, linestyle="--", linewidth=1.2, label="upstream's example pair")
    less = "move less far (cm)" if has_poses else "change less (% of a range)"
    axes.set(title=f"Share of model steps (%) that {less}", xlim=(0, far), ylim=(0, 102))
    axes.legend(frameon=True, framealpha=0.85, edgecolor="none", fontsize=7, loc="lower right")


def _strip(part: Any, strip: Strip, control_rate_hz: float, fastest: float) -> None:
    outcome, colour = _OUTCOME[strip.success]
    steps = len(strip.speed)
    grid = part.add_gridspec(
        2, 2, left=_EDGE, right=1 - _EDGE, bottom=0.15, top=0.97, wspace=0, hspace=0.04,
        width_ratios=(_LABEL, _FILM), height_ratios=(1.3, 0.5),
    )  # fmt: skip
    label = part.add_subplot(grid[:, 0])
    label.set_axis_off()
    label.add_patch(Rectangle((0, 0), 0.03, 1, color=colour))
    label.text(0.08, 1.0, textwrap.fill(strip.name, 22, max_lines=5, placeholder="…"), va="top")
    label.text(0.08, 0.47, outcome, color=colour, size=9, weight="bold", va="top")
    label.text(0.08, 0.37, f"{counted(steps, 'step')}, {steps / control_rate_hz:.1f} s", color=GREY, va="top")
    film = grid[0, 1].subgridspec(1, len(strip.frames), wspace=0.03)
    for place, frame in enumerate(strip.frames):
        axes = part.add_subplot(film[place])
        axes.set_axis_off()
        axes.imshow(_paler(frame, strip.seen), interpolation="nearest" if len(frame) < 100 else "antialiased")
    _motion_of(part.add_subplot(grid[1, 1]), strip, control_rate_hz, fastest)


def _paler(frame: UInt8[np.ndarray, "height width 3"], seen: CropBox) -> UInt8[np.ndarray, "height width 3"]:
    """Return a frame that is pale outside the part that is the model's input."""
    shown = (frame * 0.3 + 255 * 0.35).astype(np.uint8)
    part = np.s_[seen.top : seen.top + seen.height, seen.left : seen.left + seen.width]
    shown[part] = frame[part]
    return shown


def _motion_of(axes: Any, strip: Strip, control_rate_hz: float, fastest: float) -> None:
    seconds = (np.arange(len(strip.speed)) + 0.5) / control_rate_hz
    for start, end in strip.shaded:
        axes.axvspan(start / control_rate_hz, end / control_rate_hz, color=_IDLE, alpha=0.6, linewidth=0)
    axes.fill_between(seconds, strip.speed, color=BLUE, alpha=0.25, linewidth=0)
    axes.plot(seconds, strip.speed, color=BLUE, linewidth=1)
    if strip.closedness is not None:
        axes.plot(seconds, strip.closedness * fastest, color=ORANGE, linewidth=1.2)
    axes.set(xlim=(0, len(strip.speed) / control_rate_hz), ylim=(0, fastest * 1.04))
    axes.locator_params(axis="x", nbins=14)
    axes.set_yticks([0, round(fastest / 1.15)])
    axes.tick_params(labelsize=7, length=2, pad=1.5, colors=GREY)
