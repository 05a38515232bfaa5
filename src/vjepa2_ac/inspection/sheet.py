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
from vjepa2_ac.inspection.statistics import CHANGED, MOVED, RELEASED_STEP_CM, Inspection, compute_largest_changes
from vjepa2_ac.media.figure import BLUE, GREEN, GREY, ORANGE, save_figure

_MAX_POSITIONS = 6000  # maximum number of points in the plot of positions
_UNUSED = "#c9c9c9"
_OUTCOME = {True: ("success", GREEN), False: ("failure", "#c0392b"), None: ("", "#b5b5b5")}
_STRIDES = ("#7fb3dd", BLUE, "#0b3558", "#7a4fa3", "#333333")

_WIDTH, _LABEL, _IMAGES, _TITLE, _ROW, _PANELS = 11.0, 1.6, 9.0, 0.5, 1.6, 3.1  # inches
_SPEED_MARGIN = 1.15  # upper end of the speed axis, relative to the 99.5th percentile of all speeds
_EDGE = 0.2 / _WIDTH  # left and right margin, relative to the width
_MIN_IMAGES, _MAX_IMAGES, _IMAGE_HEIGHT = 4, 14, 0.8  # number of images in a row, and their height in inches


@dataclass(frozen=True, eq=False)
class Strip:
    """One row of the sheet: some frames of an episode, and its motion at every control step."""

    name: str
    success: bool | None
    frames: UInt8[np.ndarray, "time height width 3"]
    speed: Float[np.ndarray, " steps"]  # cm/s of the flange; for vectors see `plot_contact_sheet`
    gripper_position: Float[np.ndarray, " steps"] | None  # None: the states are not poses
    unused: tuple[tuple[int, int], ...]  # ranges [start, end) of steps from which no clips are taken
    crop: CropBox  # part of the image that is the model's input


def plot_dataset(inspection: Inspection, path: Path, *, rows: int = 8, progress: Progress = no_progress) -> Path:
    """Write the contact sheet of an inspected data set. Only the frames that it shows are decoded.

    Args:
        inspection: The statistics of the data set.
        path: The PNG file.
        rows: Maximum number of episodes to show.
        progress: Called with the number of episodes whose frames were read, and the number of episodes to show.

    Raises:
        InputError: A frame cannot be read, and `data.broken_episodes` does not skip its episode.
    """
    dataset, shown = inspection.dataset, inspection.sample[:rows]
    identities = [dataset.table.identity(episode.index) for episode in shown]
    names = shorten_names(identities)
    strips = []
    for num_read, (episode, identity) in enumerate(zip(shown, identities, strict=True), start=1):
        try:
            strips.append(_read_strip(inspection, episode, names[identity]))
        except InputError as error:
            dataset.skip_episode(episode.index, error)
        progress(num_read, len(shown))
    return plot_contact_sheet(inspection, strips, path)


def _read_strip(inspection: Inspection, without_frames: ReadEpisode, name: str) -> Strip:
    dataset, states = inspection.dataset, without_frames.states
    episode = dataset.source.read(without_frames.index)
    num_steps = len(states)
    steps_with_frames = np.arange(num_steps) if episode.frame_steps is None else episode.frame_steps
    height, width = episode.read_frames([int(steps_with_frames[0])]).shape[1:3]
    num_images = min(num_images_per_row(height, width), len(steps_with_frames))
    shown = ((np.arange(num_images) + 0.5) * len(steps_with_frames) / num_images).astype(np.int64)
    changes = np.gradient(states, axis=0) if num_steps > 1 else np.zeros_like(states)
    is_pose, space = inspection.has_poses, dataset.spaces.state
    is_unused = np.ones(num_steps, bool)
    for start, end in without_frames.selected:
        is_unused[start:end] = False
    change = space.compute_display_size(changes) if is_pose else compute_largest_changes(changes, inspection.ranges)
    return Strip(
        name=name,
        success=episode.info.success,
        frames=episode.read_frames([int(step) for step in steps_with_frames[shown]]),
        speed=change * episode.control_rate_hz,
        gripper_position=states[:, space.gripper] if is_pose else None,
        unused=tuple(find_runs(is_unused)),
        crop=crop_box(height, width, dataset.config.crop),
    )


# ---- drawing ----


def num_images_per_row(height: int, width: int) -> int:
    """Return the number of images with this height and width that fit into a row of the sheet."""
    return int(min(max(_IMAGES // (_IMAGE_HEIGHT * width / height + 0.06), _MIN_IMAGES), _MAX_IMAGES))


def plot_contact_sheet(inspection: Inspection, strips: Sequence[Strip], path: Path) -> Path:
    """Write the contact sheet of a data set as a PNG file, atomically.

    For poses the motion of the flange is shown in cm. For vectors it is the largest change of any number, in percent of
    the range of the number, and the ranges of all numbers replace the map of positions.
    """
    dataset, heights = inspection.dataset, [_TITLE, _PANELS, *(_ROW for _ in strips)]
    with save_figure(path, _WIDTH, sum(heights), dpi=130, layout="none", facecolor="white") as figure:
        title, panels, *rows = figure.subfigures(len(heights), 1, height_ratios=heights)
        title.text(_EDGE, 0.5, dataset.config.path, size=13, weight="bold", va="center")
        _draw_panels(panels, inspection)
        speeds = np.concatenate([strip.speed for strip in strips]) if strips else np.zeros(1)
        max_speed = max(float(np.percentile(speeds, 99.5)) * _SPEED_MARGIN, 1.0)
        for row, strip in zip(rows, strips, strict=True):
            _draw_strip(row, strip, dataset.control_rate_hz, max_speed)
        if rows:
            _label_time(rows[-1])
    return path


def _draw_panels(figure: Any, inspection: Inspection) -> None:
    """Draw the plots of the whole data set (lengths, motion per model step, positions, directions) and the legend."""
    dataset, has_poses = inspection.dataset, inspection.has_poses
    lengths_s = dataset.table.num_steps / dataset.control_rate_hz
    edges = {"left": 0.05, "right": 0.93, "bottom": 0.42, "top": 0.93}
    grid = figure.add_gridspec(1, 4, **edges, wspace=0.4, width_ratios=(1.9, 3.7, 3.6, 3.0))
    axes = figure.add_subplot(grid[0])
    axes.hist(lengths_s, bins=min(40, max(5, len(lengths_s) // 2)), color=GREY)
    axes.set(title="Episode length", xlabel="length (s)", ylabel="number of episodes")
    axes.locator_params(axis="x", nbins=4)
    axes.locator_params(axis="y", nbins=4, integer=True)
    _draw_motion(figure.add_subplot(grid[1]), inspection)
    if has_poses:
        positions = np.concatenate([episode.states[:, dataset.spaces.state.size_axes] for episode in inspection.sample])
        positions = positions[:: -(-len(positions) // _MAX_POSITIONS)]
        axes = figure.add_subplot(grid[2])
        points = axes.scatter(-positions[:, 1], positions[:, 0], c=positions[:, 2], s=2, cmap="viridis", linewidths=0)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(title="Flange positions from above", xlabel="-y: right of the robot (m)", ylabel="x: forward (m)")
        axes.locator_params(nbins=5)
        figure.colorbar(points, ax=axes, fraction=0.04, pad=0.02, label="z: height (m)")
    if (coverage := inspection.coverage) is not None and coverage.density is not None:
        _draw_directions(figure, figure.add_subplot(grid[3]), coverage.density)
    if not has_poses:
        axes, ranges = figure.add_subplot(grid[2:]), inspection.ranges
        axes.bar(np.arange(len(ranges)), ranges[:, 1] - ranges[:, 0], bottom=ranges[:, 0], color=BLUE)
        axes.set(title="Range of each number of the state", xlabel="index of the number, from 0", ylabel="value")
        axes.locator_params(axis="x", integer=True)
    speed = "speed of the flange (cm/s)" if has_poses else "largest change of a number (% of its range per second)"
    legend = {speed: BLUE} | ({"gripper (bottom: open, top: closed)": ORANGE} if has_poses else {})
    legend |= {"steps not used": _UNUSED, "pale image borders: outside the model's crop": "none"}
    handles = [Patch(color=colour, label=label) for label, colour in legend.items()]
    figure.legend(handles=handles, loc="lower right", ncols=4, fontsize=8, handlelength=1)


def _draw_directions(figure: Any, axes: Any, density: Float[np.ndarray, "rows columns"]) -> None:
    """Draw the density of directions as an equal-area map of the sphere, with x (forward) in the middle and z up."""
    extent = (-180.0, 180.0, -1.0, 1.0)
    image = axes.imshow(density, extent=extent, origin="lower", aspect="auto", cmap="Blues", vmin=0, vmax=2)
    axes.set(title=f"Directions of motion: {100 * (density >= ENOUGH_NEAR).mean():.0f} % covered")
    axes.set(xlabel="horizontal direction")
    axes.set_xticks([-180, -90, 0, 90, 180], ["-x", "-y", "+x", "+y", "-x"])
    axes.set_yticks([-1, 0, 1], ["-z", "0", "+z"])
    label = f"density / uniform density\n(covered: {ENOUGH_NEAR:g} or more)"
    figure.colorbar(image, ax=axes, fraction=0.04, pad=0.02, ticks=[0, ENOUGH_NEAR, 1, 2], label=label)


def _draw_motion(axes: Any, inspection: Inspection) -> None:
    """Draw the cumulative distribution of the motion in a model step, for each candidate stride."""
    has_poses, rate_hz = inspection.has_poses, inspection.dataset.control_rate_hz
    unit, reference = ("cm", RELEASED_STEP_CM) if has_poses else ("%", 1.0)
    by_stride = {stride: sizes[MOVED if has_poses else CHANGED] for stride, sizes in inspection.steps.items()}
    limit = max([reference * 1.3, *(float(np.percentile(sizes, 97)) for sizes in by_stride.values() if len(sizes))])
    thresholds = np.linspace(0, limit, 200)
    for (stride, sizes), colour in zip(by_stride.items(), _STRIDES, strict=False):
        if not len(sizes):
            continue
        percent = np.searchsorted(np.sort(sizes), thresholds, side="right") / len(sizes) * 100
        label = f"stride {stride} ({stride / rate_hz:.2f} s), median {np.median(sizes):.1f} {unit}"
        axes.plot(thresholds, percent, color=colour, linewidth=1.5, label=label)
    if has_poses:
        label = f"step in Meta's example, {reference:g} cm"
        axes.axvline(reference, color=ORANGE, linestyle="--", linewidth=1.2, label=label)
    size = "distance (cm)" if has_poses else "largest change of a number (% of its range)"
    axes.set(title="Motion per model step (cumulative)", xlabel=size, ylabel="model steps (%)")
    axes.set(xlim=(0, limit), ylim=(0, 102))
    axes.legend(
        fontsize=7, loc="upper center", bbox_to_anchor=(0.46, -0.26), ncols=2, columnspacing=1.2, handlelength=1.4
    )


def _draw_strip(figure: Any, strip: Strip, control_rate_hz: float, max_speed: float) -> None:
    outcome, colour = _OUTCOME[strip.success]
    num_steps = len(strip.speed)
    grid = figure.add_gridspec(
        2, 2, left=_EDGE, right=1 - _EDGE, bottom=0.15, top=0.97, wspace=0, hspace=0.04,
        width_ratios=(_LABEL, _IMAGES), height_ratios=(1.3, 0.5),
    )  # fmt: skip
    label = figure.add_subplot(grid[:, 0])
    label.set_axis_off()
    label.add_patch(Rectangle((0, 0), 0.03, 1, color=colour))
    label.text(0.08, 1.0, textwrap.fill(strip.name, 20, max_lines=5, placeholder="…"), va="top")
    label.text(0.08, 0.47, outcome, color=colour, size=9, weight="bold", va="top")
    label.text(0.08, 0.37, f"{counted(num_steps, 'step')}, {num_steps / control_rate_hz:.1f} s", color=GREY, va="top")
    images = grid[0, 1].subgridspec(1, len(strip.frames), wspace=0.03)
    for index, frame in enumerate(strip.frames):
        axes = figure.add_subplot(images[index])
        axes.set_axis_off()
        pixels = _pale_outside_crop(frame, strip.crop)
        axes.imshow(pixels, interpolation="nearest" if len(frame) < 100 else "antialiased")
    _draw_strip_motion(figure.add_subplot(grid[1, 1]), strip, control_rate_hz, max_speed)


def _pale_outside_crop(
    frame: UInt8[np.ndarray, "height width 3"], crop: CropBox
) -> UInt8[np.ndarray, "height width 3"]:
    """Return a copy of a frame that is pale outside the crop of the model's input."""
    pale = (frame * 0.3 + 255 * 0.35).astype(np.uint8)
    inside = np.s_[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
    pale[inside] = frame[inside]
    return pale


def _draw_strip_motion(axes: Any, strip: Strip, control_rate_hz: float, max_speed: float) -> None:
    seconds = (np.arange(len(strip.speed)) + 0.5) / control_rate_hz
    for start, end in strip.unused:
        axes.axvspan(start / control_rate_hz, end / control_rate_hz, color=_UNUSED, alpha=0.6, linewidth=0)
    axes.fill_between(seconds, strip.speed, color=BLUE, alpha=0.25, linewidth=0)
    axes.plot(seconds, strip.speed, color=BLUE, linewidth=1)
    if strip.gripper_position is not None:
        axes.plot(seconds, strip.gripper_position * max_speed, color=ORANGE, linewidth=1.2)
    axes.set(xlim=(0, len(strip.speed) / control_rate_hz), ylim=(0, max_speed * 1.04))
    axes.locator_params(axis="x", nbins=14)
    axes.set_yticks([0, round(max_speed / _SPEED_MARGIN)])
    axes.tick_params(labelsize=7, length=2, pad=1.5, colors=GREY)


def _label_time(figure: Any) -> None:
    """Write the label of the time axis below the last row."""
    figure.text(
        _EDGE + (1 - 2 * _EDGE) * (_LABEL + _IMAGES / 2) / (_LABEL + _IMAGES),
        0.0,
        "time (s)",
        color=GREY,
        ha="center",
        va="bottom",
        size=7,
    )
