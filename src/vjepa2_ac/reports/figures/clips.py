"""The figure of clips: one row per clip with some of its frames, and its states and actions over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.data.windows import spread_with_ends
from vjepa2_ac.reports.figures.page import written_page

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
    style, height = {"font.size": 8}, 0.6 + 3.2 * len(clips)
    with written_page(path, 16.0, height, dpi=80, style=style, layout="constrained", facecolor="white") as page:
        page.headline(title)
        for part, clip in zip(page.figure.subfigures(len(clips), 1, squeeze=False)[:, 0], clips, strict=True):
            grid = part.add_gridspec(2, len(clip.numbers), height_ratios=(3, 2))
            film = part.add_subplot(grid[0, :])
            film.imshow(np.concatenate(clip.frames[spread_with_ends(len(clip.frames), _MOST_FRAMES)], axis=1))
            film.set(title=clip.name)
            film.set_axis_off()
            for column, (what, values) in enumerate(clip.numbers.items()):
                _plot(part.add_subplot(grid[1, column]), what, values)
    return path


def _plot(axes: Any, what: str, values: Float[np.ndarray, "_ _"]) -> None:
    axes.plot(values, linewidth=1)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    for step in bad:
        axes.axvspan(step - 0.5, step + 0.5, color=_BAD, alpha=0.3, linewidth=0)
    label = f"{what}: not finite in {len(bad)} of {len(values)} steps" if len(bad) else what
    axes.set_title(label, fontsize=8, color=_BAD if len(bad) else "black")
    axes.set_xlim(-0.5, len(values) - 0.5)
