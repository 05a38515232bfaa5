"""The contact sheet of a data set: episodes as film strips and their motion, below a summary of the data set."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.patches import Rectangle

from vjepa2_ac.data.coverage import ENOUGH_NEAR
from vjepa2_ac.data.transforms import CropBox
from vjepa2_ac.reports.figures.page import BLUE, GREEN, GREY, ORANGE, Page, written_page

_INK, _FAINT, _SPEED, _GRIPPER, _IDLE = "#222222", GREY, BLUE, ORANGE, "#c9c9c9"
_OUTCOME = {True: ("success", GREEN), False: ("failure", "#c0392b"), None: ("", "#b5b5b5")}
_STRIDES = ("#7fb3dd", BLUE, "#0b3558", "#7a4fa3", "#333333")

# Inches.
_WIDTH, _SIDE, _LABEL, _PICTURE, _PLOT, _AXIS, _BETWEEN = 16.0, 0.2, 1.75, 1.3, 0.5, 0.2, 0.14
_TITLE, _LINE, _PANELS = 0.42, 0.2, 1.75
_GAP = 0.06
_LEAST, _MOST, _WELCOME = 4, 14, 1.15  # pictures in a row, and the height at which they are counted


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
    across = _WIDTH - 2 * _SIDE - _LABEL
    return int(min(max(across // (_WELCOME * width / height + _GAP), _LEAST), _MOST))


def plot_contact_sheet(sheet: ContactSheet, path: Path) -> Path:
    """Write the contact sheet of a data set as PNG; it is written atomically."""
    facts = [line for fact in sheet.facts for line in textwrap.wrap(fact, 205, subsequent_indent="    ")]
    head = _TITLE + _LINE * len(facts) + 0.3 + _PANELS + 0.75
    row = _PICTURE + _PLOT + _AXIS + _BETWEEN
    height = head + row * len(sheet.strips) + 0.15
    style = {"text.color": _INK, "font.size": 8, "axes.linewidth": 0.6}
    with written_page(path, _WIDTH, height, dpi=100, style=style, facecolor="white") as page:
        page.text(_SIDE, 0.16, sheet.title, size=13, weight="bold")
        for number, line in enumerate(facts):
            page.text(_SIDE, _TITLE + 0.06 + _LINE * number, line, size=9)
        _panels(page, sheet, top=_TITLE + _LINE * len(facts) + 0.3)
        _legend(page, sheet, top=head - 0.22)
        fastest = _fastest(sheet.strips)
        for number, strip in enumerate(sheet.strips):
            _strip(page, strip, sheet.control_rate_hz, fastest, top=head + row * number)
    return path


def _panels(page: Page, sheet: ContactSheet, top: float) -> None:
    """Draw the small plots of the whole set: lengths, motion per model step, places and directions."""
    lengths = page.axes(0.6, top, 2.4, _PANELS)
    lengths.hist(sheet.lengths_s, bins=min(40, max(5, len(sheet.lengths_s) // 2)), color=_FAINT)
    lengths.set_title("Length of episodes (s)")
    lengths.locator_params(axis="y", nbins=4, integer=True)
    _motion(page.axes(3.6, top, 4.6, _PANELS), sheet)
    if sheet.places_m is not None:
        _places(page, sheet.places_m, top)
    if sheet.directions is not None:
        _directions(page, sheet.directions, top)
    if sheet.ranges is not None:
        _ranges(page.axes(8.9, top, 6.7, _PANELS), sheet.ranges)


def _places(page: Page, places_m: Float[np.ndarray, "points 3"], top: float) -> None:
    places = page.axes(8.9, top, 3.2, _PANELS)
    shown = places.scatter(-places_m[:, 1], places_m[:, 0], c=places_m[:, 2], s=2, cmap="viridis", linewidths=0)
    places.set_aspect("equal", adjustable="datalim")
    places.set(title="Where the flange was, from above (m; colour: height)")
    places.set(xlabel="-y: to the robot's right", ylabel="x: forward")
    places.locator_params(nbins=5)
    page.figure.colorbar(shown, ax=places, fraction=0.04, pad=0.02)


def _directions(page: Page, directions: Float[np.ndarray, "rows columns"], top: float) -> None:
    """Draw the sphere of directions, each of the same area, as a map: x forward in the middle, z up."""
    axes = page.axes(12.75, top, 2.85, _PANELS)
    extent = (-180.0, 180.0, -1.0, 1.0)
    shown = axes.imshow(directions, extent=extent, origin="lower", aspect="auto", cmap="Blues", vmin=0, vmax=2)
    if directions.min() < ENOUGH_NEAR < directions.max():
        axes.contour(directions, [ENOUGH_NEAR], extent=extent, origin="lower", colors=_GRIPPER, linewidths=1.2)
    share = (directions >= ENOUGH_NEAR).mean()
    axes.set_title(f"Directions of steps: {share:.0%} are taught")
    axes.set_xticks([-180, -90, 0, 90, 180], ["-x", "-y", "+x", "+y", "-x"])
    axes.set_yticks([-1, 0, 1], ["-z", "", "+z"])
    page.figure.colorbar(shown, ax=axes, fraction=0.04, pad=0.02, ticks=[0, ENOUGH_NEAR, 1, 2])


def _ranges(axes: Any, ranges: Float[np.ndarray, "state_dim 2"]) -> None:
    axes.bar(np.arange(len(ranges)), ranges[:, 1] - ranges[:, 0], bottom=ranges[:, 0], color=_SPEED)
    axes.set(title="Range of each number of the state", xlabel="number, from 0")
    axes.locator_params(axis="x", integer=True)


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
        axes.axvline(sheet.reference, color=_GRIPPER, linestyle="--", linewidth=1.2, label="upstream's example pair")
    less = "move the flange less far than this (cm)" if has_poses else "change no number by more (% of its range)"
    axes.set(title=f"Share of model steps (%) that {less}", xlim=(0, far), ylim=(0, 102))
    axes.legend(frameon=True, framealpha=0.85, edgecolor="none", fontsize=8, loc="lower right")


def _legend(page: Page, sheet: ContactSheet, top: float) -> None:
    speed = "speed (cm/s)" if sheet.places_m is not None else "fastest number (% of its range per second)"
    entries = [(speed, _SPEED)]
    if sheet.places_m is not None:
        entries.append(("gripper: 0 open, 1 closed", _GRIPPER))
    if sheet.shaded_means:
        entries.append((sheet.shaded_means, _FAINT))
    left = _SIDE + _LABEL
    for words, colour in entries:
        page.text(left, top, f"■ {words}", color=colour, size=9)
        left += 0.42 + 0.078 * len(words)
    page.text(left, top, "bright part of a picture: what the model sees", color=_INK, size=9)


def _fastest(strips: Sequence[Strip]) -> float:
    speeds = np.concatenate([strip.speed for strip in strips]) if strips else np.zeros(1)
    return max(float(np.percentile(speeds, 99.5)) * 1.15, 1.0)


def _strip(page: Page, strip: Strip, control_rate_hz: float, fastest: float, top: float) -> None:
    left, across = _SIDE + _LABEL, _WIDTH - 2 * _SIDE - _LABEL
    words, colour = _OUTCOME[strip.success]
    steps = len(strip.speed)
    mark = page.axes(_SIDE, top, 0.05, _PICTURE + _PLOT)
    mark.set_axis_off()
    mark.add_patch(Rectangle((0, 0), 1, 1, color=colour))
    page.text(_SIDE + 0.14, top, _wrapped(strip.name), size=8)
    page.text(_SIDE + 0.14, top + 0.84, words, color=colour, size=9, weight="bold")
    page.text(_SIDE + 0.14, top + 1.02, f"{steps} steps, {steps / control_rate_hz:.1f} s", size=8, color=_FAINT)
    slot = across / len(strip.frames)
    height, width = strip.frames.shape[1:3]
    shown_width = min(slot - _GAP, _PICTURE * width / height)
    film = page.axes(left, top, across, _PICTURE)
    film.set_axis_off()
    for number, frame in enumerate(strip.frames):
        start = (number + 0.5) * slot - shown_width / 2
        _picture(film, frame, strip.seen, (start, start + shown_width, shown_width * height / width, 0.0))
    film.set(xlim=(0, across), ylim=(_PICTURE, 0), aspect="auto")
    _motion_of(page.axes(left, top + _PICTURE + 0.03, across, _PLOT), strip, control_rate_hz, fastest)


def _wrapped(name: str, across: int = 22, down: int = 5) -> str:
    """Break a name, which has no spaces, into lines; the first of them where it is too long."""
    lines = [name[start : start + across] for start in range(0, len(name), across)]
    if len(lines) > down:
        lines = [*lines[: down - 1], lines[down - 1][: across - 1] + "…"]
    return "\n".join(lines)


def _picture(
    axes: Any, frame: UInt8[np.ndarray, "height width 3"], seen: CropBox, extent: tuple[float, float, float, float]
) -> None:
    shown = (frame * 0.3 + 255 * 0.35).astype(np.uint8)
    part = np.s_[seen.top : seen.top + seen.height, seen.left : seen.left + seen.width]
    shown[part] = frame[part]
    axes.imshow(shown, extent=extent, interpolation="nearest" if len(frame) < 100 else "bilinear")


def _motion_of(axes: Any, strip: Strip, control_rate_hz: float, fastest: float) -> None:
    seconds = (np.arange(len(strip.speed)) + 0.5) / control_rate_hz
    for start, end in strip.shaded:
        axes.axvspan(start / control_rate_hz, end / control_rate_hz, color=_IDLE, alpha=0.6, linewidth=0)
    axes.fill_between(seconds, strip.speed, color=_SPEED, alpha=0.25, linewidth=0)
    axes.plot(seconds, strip.speed, color=_SPEED, linewidth=1)
    if strip.closedness is not None:
        axes.plot(seconds, strip.closedness * fastest, color=_GRIPPER, linewidth=1.2)
    axes.set(xlim=(0, len(strip.speed) / control_rate_hz), ylim=(0, fastest * 1.04))
    axes.locator_params(axis="x", nbins=14)
    axes.set_yticks([0, round(fastest / 1.15)])
    axes.tick_params(labelsize=7, length=2, pad=1.5, colors=_FAINT)
