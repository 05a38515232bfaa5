"""The figure of clips: one row per clip with some of its frames, and its states and actions over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.data.windows import spread_with_ends
from vjepa2_ac.reports.figures.page import Page, written_page

_WIDTH, _SIDE, _TITLE = 16.0, 0.3, 0.6  # inches, as all below
_NAME, _FILM, _LABEL, _PLOT, _BETWEEN = 0.25, 1.4, 0.3, 0.9, 0.35
_MOST_FRAMES = 8
_BAD = "#c0392b"


@dataclass(frozen=True, eq=False)
class ClipFigure:
    """One clip of the figure."""

    name: str
    frames: UInt8[np.ndarray, "time height width 3"]
    numbers: dict[str, Float[np.ndarray, "_ _"]]  # by name: a row per model step


def plot_clips(title: str, clips: Sequence[ClipFigure], path: Path) -> Path:
    """Write a figure of some clips as PNG; numbers that are not finite are marked. It is written atomically.

    Raises:
        ValueError: There is no clip.
    """
    if not clips:
        raise ValueError("no clip to show")
    row = _NAME + _FILM + _LABEL + _PLOT + _BETWEEN
    height = _TITLE + row * len(clips)
    with written_page(path, _WIDTH, height, dpi=80, style={"font.size": 8}, facecolor="white") as page:
        page.text(_SIDE, 0.2, title, size=12.0)
        for number, clip in enumerate(clips):
            _draw(page, clip, top=_TITLE + row * number)
    return path


def _draw(page: Page, clip: ClipFigure, top: float) -> None:
    page.text(_SIDE, top, clip.name, size=9.0)
    film = page.axes(_SIDE, top + _NAME, _WIDTH - 2 * _SIDE, _FILM)
    film.imshow(_film(clip.frames))
    film.set_anchor("W")
    film.set_axis_off()
    across = (_WIDTH - _SIDE) / len(clip.numbers)
    for column, (what, values) in enumerate(clip.numbers.items()):
        left = _SIDE + 0.3 + column * across
        _plot(page.axes(left, top + _NAME + _FILM + _LABEL, across - 0.6, _PLOT), what, values)


def _film(frames: UInt8[np.ndarray, "time height width 3"]) -> UInt8[np.ndarray, "height _ 3"]:
    """Return some frames side by side, with a little white between them."""
    chosen = spread_with_ends(len(frames), _MOST_FRAMES)
    gap = max(1, frames.shape[2] // 50)
    spaced = np.pad(frames[chosen], ((0, 0), (0, 0), (0, gap), (0, 0)), constant_values=255)
    return np.concatenate(list(spaced), axis=1)


def _plot(axes: Any, what: str, values: Float[np.ndarray, "_ _"]) -> None:
    axes.plot(values, linewidth=1)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    for step in bad:
        axes.axvspan(step - 0.5, step + 0.5, color=_BAD, alpha=0.3, linewidth=0)
    label = f"{what}: not finite in {len(bad)} of {len(values)} steps" if len(bad) else what
    axes.set_title(label, fontsize=8, color=_BAD if len(bad) else "black")
    axes.set_xlim(-0.5, len(values) - 0.5)
