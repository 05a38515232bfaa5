"""The contact sheet of a data set: episodes as film strips and their motion, below a summary of the data set."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.patches import Patch, Rectangle

from vjepa2_ac.data.coverage import ENOUGH_NEAR
from vjepa2_ac.data.transforms import CropBox
from vjepa2_ac.media.figure import BLUE, GREEN, GREY, ORANGE, written_figure

_IDLE = "#c9c9c9"
_OUTCOME = {True: ("success", GREEN), False: ("failure", "#c0392b"), None: ("", "#b5b5b5")}
_STRIDES = ("#7fb3dd", BLUE, "#0b3558", "#7a4fa3", "#333333")

_WIDTH, _LABEL, _FILM, _ROW, _PANELS = 11.0, 1.6, 9.0, 1.6, 2.5  # inches
_EDGE = 0.2 / _WIDTH  # of the sheet, left and right
_LEAST, _MOST, _PICTURE = 4, 14, 0.8  # pictures in a row, and the height in inches at which they are counted


@dataclass(frozen=True, eq=False)
class Strip:
    """One episode: some of its frames, and its motion at every control step."""

    name: str
    success: bool | None
    frames: UInt8[np.ndarray, "time height width 3"]
    steps: Int[np.ndarray, " time"]  # control steps of the pictures
    speed: Float[np.ndarray, " steps"]  # per second, in the unit of the sheet
    closedness: Float[np.ndarray, " steps"] | None  # None: the states are no poses
    shaded: tuple[tuple[int, int], ...]  # ranges [start, end) of steps: idle, or left out
    seen: CropBox  # what the model sees of a picture


@dataclass(frozen=True, eq=False)
class ContactSheet:
    """The content of a data set's contact sheet.

    Its unit of motion is cm of the flange. For vectors it is the change of the number that changes most, as a
    percentage of its range; these have no positions in space.
    """

    title: str
    facts: tuple[str, ...]  # lines
    strips: tuple[Strip, ...]
    control_rate_hz: float
    lengths_s: Float[np.ndarray, " episodes"]  # of all episodes
    moved: Mapping[int, Float[np.ndarray, " pairs"]]  # stride -> per model step
    reference: float | None  # a step that the released weights are known to have seen
    places_m: Float[np.ndarray, "points 3"] | None  # where the flange was
    shaded_means: str  # what the shaded parts of a strip are; empty: there are none
    ranges: Float[np.ndarray, "state_dim 2"] | None = None  # of vectors: the least and greatest value of each number
    directions: Float[np.ndarray, "rows columns"] | None = None  # of steps: how frequent, over all being equally so


def pictures_per_row(height: int, width: int) -> int:
    """Return the number of frames of a size in a row of the sheet."""
    return int(min(max(_FILM // (_PICTURE * width / height + 0.06), _LEAST), _MOST))


def plot_contact_sheet(sheet: ContactSheet, path: Path) -> Path:
    """Write the contact sheet of a data set as PNG; it is written atomically."""
    facts = [line for fact in sheet.facts for line in textwrap.wrap(fact, 150, subsequent_indent="    ")]
    heights = [0.7 + 0.18 * len(facts), _PANELS, *(_ROW for _ in sheet.strips)]
    with written_figure(path, _WIDTH, sum(heights), dpi=130, layout="none", facecolor="white") as figure:
        words, panels, *rows = figure.subfigures(len(heights), 1, height_ratios=heights)
        words.text(_EDGE, 1 - 0.16 / heights[0], sheet.title, size=13, weight="bold", va="top")
        words.text(_EDGE, 1 - 0.5 / heights[0], "\n".join(facts), size=9, va="top", linespacing=1.4)
        _panels(panels, sheet)
        speeds = np.concatenate([strip.speed for strip in sheet.strips]) if sheet.strips else np.zeros(1)
        fastest = max(float(np.percentile(speeds, 99.5)) * 1.15, 1.0)
        for part, strip in zip(rows, sheet.strips, strict=True):
            _strip(part, strip, sheet.control_rate_hz, fastest)
    return path


def _panels(part: Any, sheet: ContactSheet) -> None:
    """Draw the small plots of the whole set: lengths, motion per model step, places and directions."""
    edges = {"left": 0.04, "right": 0.96, "bottom": 0.34, "top": 0.9}
    grid = part.add_gridspec(1, 4, **edges, wspace=0.28, width_ratios=(2.0, 4.2, 3.4, 3.0))
    lengths = part.add_subplot(grid[0])
    lengths.hist(sheet.lengths_s, bins=min(40, max(5, len(sheet.lengths_s) // 2)), color=GREY)
    lengths.set_title("Episodes by length (s)")
    lengths.locator_params(axis="y", nbins=4, integer=True)
    _motion(part.add_subplot(grid[1]), sheet)
    if (places := sheet.places_m) is not None:
        axes = part.add_subplot(grid[2])
        shown = axes.scatter(-places[:, 1], places[:, 0], c=places[:, 2], s=2, cmap="viridis", linewidths=0)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(title="Flange, from above (m)")
        axes.set(xlabel="-y: to the robot's right", ylabel="x: forward")
        axes.locator_params(nbins=5)
        part.colorbar(shown, ax=axes, fraction=0.04, pad=0.02)
    if sheet.directions is not None:
        _directions(part, part.add_subplot(grid[3]), sheet.directions)
    if (ranges := sheet.ranges) is not None:
        axes = part.add_subplot(grid[2:])
        axes.bar(np.arange(len(ranges)), ranges[:, 1] - ranges[:, 0], bottom=ranges[:, 0], color=BLUE)
        axes.set(title="Range of each number of the state", xlabel="number, from 0")
        axes.locator_params(axis="x", integer=True)
    has_poses = sheet.places_m is not None
    speed = "speed (cm/s)" if has_poses else "fastest number (% of its range per second)"
    meanings = {speed: BLUE} | ({"gripper: 0 open, 1 closed": ORANGE} if has_poses else {})
    meanings |= {sheet.shaded_means: _IDLE} if sheet.shaded_means else {}
    meanings["bright part of a picture: what the model sees"] = "none"
    handles = [Patch(color=colour, label=label) for label, colour in meanings.items()]
    part.legend(handles=handles, loc="lower right", ncols=4, fontsize=9, handlelength=1)


def _directions(part: Any, axes: Any, directions: Float[np.ndarray, "rows columns"]) -> None:
    """Draw the sphere of directions, each of the same area, as a map: x forward in the middle, z up."""
    extent = (-180.0, 180.0, -1.0, 1.0)
    shown = axes.imshow(directions, extent=extent, origin="lower", aspect="auto", cmap="Blues", vmin=0, vmax=2)
    if directions.min() < ENOUGH_NEAR < directions.max():
        axes.contour(directions, [ENOUGH_NEAR], extent=extent, origin="lower", colors=ORANGE, linewidths=1.2)
    share = (directions >= ENOUGH_NEAR).mean()
    axes.set_title(f"Directions: {share:.0%} taught")
    axes.set_xticks([-180, -90, 0, 90, 180], ["-x", "-y", "+x", "+y", "-x"])
    axes.set_yticks([-1, 0, 1], ["-z", "", "+z"])
    part.colorbar(shown, ax=axes, fraction=0.04, pad=0.02, ticks=[0, ENOUGH_NEAR, 1, 2])


def _motion(axes: Any, sheet: ContactSheet) -> None:
    has_poses = sheet.places_m is not None
    unit = "cm" if has_poses else "%"
    values = [moved for moved in sheet.moved.values() if len(moved)]
    far = max([(sheet.reference or 1.0) * 1.3, *(float(np.percentile(moved, 97)) for moved in values)])
    reached = np.linspace(0, far, 200)
    for (stride, moved), colour in zip(sheet.moved.items(), _STRIDES, strict=False):
        if not len(moved):
            continue
        share = np.searchsorted(np.sort(moved), reached, side="right") / len(moved) * 100
        label = f"stride {stride} ({stride / sheet.control_rate_hz:.2f} s): median {np.median(moved):.1f} {unit}"
        axes.plot(reached, share, color=colour, linewidth=1.5, label=label)
    if sheet.reference is not None:
        axes.axvline(sheet.reference, color=ORANGE, linestyle="--", linewidth=1.2, label="upstream's example pair")
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
    label.text(0.08, 0.37, f"{steps} steps, {steps / control_rate_hz:.1f} s", color=GREY, va="top")
    film = grid[0, 1].subgridspec(1, len(strip.frames), wspace=0.03)
    for place, frame in enumerate(strip.frames):
        axes = part.add_subplot(film[place])
        axes.set_axis_off()
        axes.imshow(_paler(frame, strip.seen), interpolation="nearest" if len(frame) < 100 else "antialiased")
    _motion_of(part.add_subplot(grid[1, 1]), strip, control_rate_hz, fastest)


def _paler(frame: UInt8[np.ndarray, "height width 3"], seen: CropBox) -> UInt8[np.ndarray, "height width 3"]:
    """Return a frame that is pale where the model does not see it."""
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
