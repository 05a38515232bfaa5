"""Lines of text on an array of pixels: measured, shortened, and drawn all at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.font_manager import FontProperties

from vjepa2_ac.reports.figures.page import new_figure

_DOTS = 100  # per inch
_FONT = "DejaVu Sans"  # comes with matplotlib: the same on every machine
Weight = Literal["normal", "bold"]


@dataclass(frozen=True)
class TextLine:
    """A line of text, centred vertically at `y`."""

    text: str
    x: float  # pixels from the left
    y: float  # pixels from the top
    points: float = 9.0
    colour: str = "#222222"
    weight: Weight = "normal"
    align: Literal["left", "center", "right"] = "left"


def lettered(
    canvas: UInt8[np.ndarray, "height width 3"], lines: Sequence[TextLine]
) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image with lines of text on it; every other pixel is unchanged."""
    height, width, _ = canvas.shape
    figure = new_figure(width / _DOTS, height / _DOTS, dpi=_DOTS)
    figure.patch.set_alpha(0.0)
    figure.figimage(canvas, resize=False)
    for line in lines:
        figure.text(
            line.x / width, 1 - line.y / height, line.text, fontproperties=_font(line.points, line.weight),
            color=line.colour, ha=line.align, va="center_baseline", parse_math=False,
        )  # fmt: skip
    drawn: Any = figure.canvas
    drawn.draw()
    return np.asarray(drawn.buffer_rgba())[..., :3].copy()


def text_width(text: str, points: float, weight: Weight = "normal") -> float:
    """Return how many pixels wide a line of text is."""
    return float(_renderer().get_text_width_height_descent(text, _font(points, weight), ismath=False)[0])


def fitted(text: str, width: float, points: float, weight: Weight = "normal") -> str:
    """Return a text that is at most so many pixels wide, shortened at its end where it has to be."""
    if text_width(text, points, weight) <= width:
        return text
    count = len(text)
    while count and text_width(text[:count].rstrip(" ,") + "…", points, weight) > width:
        count -= 1
    return text[:count].rstrip(" ,") + "…"


def wrapped(text: str, width: float, points: float, *, most: int, weight: Weight = "normal") -> list[str]:
    """Return a text as at most so many lines, broken at spaces; what is left over is cut from the last one."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and (len(lines) == most or text_width(longer, points, weight) <= width):
            lines[-1] = longer
        else:
            lines.append(word)
    return [fitted(line, width, points, weight) for line in lines]


@lru_cache(maxsize=1)
def _renderer() -> RendererAgg:
    return RendererAgg(8, 8, _DOTS)


@lru_cache(maxsize=32)
def _font(points: float, weight: Weight) -> FontProperties:
    return FontProperties(family=_FONT, size=points, weight=weight)
