"""Figures in one style: as PNG files, as pixels, and as SVG for a page."""

from __future__ import annotations

import base64
import io
import re
import textwrap
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from vjepa2_ac.storage import atomic_writer

# What a page or an image may not hold, or what misleads a reader: control characters, halves of surrogate pairs,
# noncharacters, and marks that change the direction of text.
_HIDDEN = re.compile("[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u202a-\\u202e\\u2066-\\u2069\\ud800-\\udfff\\ufffe\\uffff]")
GREY, BLUE, ORANGE, GREEN, RED = "#8a8a8a", "#1f6fb4", "#d1762a", "#2b8a3e", "#b3246b"
_STYLE = {
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 9,
    "legend.frameon": False,
    "text.parse_math": False,  # what people call things is shown as it is: a dollar sign begins no formula
}


def headline(figure: Any, words: str) -> None:
    """Write one line above a figure, whose layout makes room for it; what does not fit is left out."""
    line = textwrap.shorten(words, int(12 * figure.get_figwidth()), placeholder=" …")  # 12 letters in an inch
    figure.suptitle(line, fontsize=10.5, x=0.01, ha="left")


@contextmanager
def written_figure(
    path: Path, width: float, height: float, *, dpi: int = 100, size: float = 8, **options: Any
) -> Iterator[Any]:
    """Yield a figure of so many inches to draw on, which is then written as PNG, atomically.

    Args:
        path: The file.
        width: In inches.
        height: Likewise.
        dpi: Pixels per inch.
        size: Of the letters, in points.
        options: Of the figure.
    """
    with in_our_style({"font.size": size}):
        figure = new_figure(width, height, **{"layout": "constrained", **options})
        yield figure
        with atomic_writer(path) as file:
            figure.savefig(file, format="png", dpi=dpi)


def in_our_style(changes: dict[str, Any]) -> AbstractContextManager[None]:
    """Return a context in which matplotlib draws in the style of all our figures, but for some changes."""
    return mpl.rc_context(_STYLE | changes)


def pixels_of(figure: Any) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a figure, and return its pixels."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()


def new_figure(width: float, height: float, **options: Any) -> Figure:
    """Return a figure of so many inches with a canvas of its own: pyplot keeps figures, and may open windows."""
    figure = Figure(figsize=(width, height), **options)
    FigureCanvasAgg(figure)
    return figure


def svg_of(draw: Callable[..., None], width: float, height: float, *given: Any) -> str:
    """Return what is drawn of what is given, so many inches large, as SVG in a data: URL; always the same bytes."""
    style = {"font.size": 9, "legend.fontsize": 8, "svg.fonttype": "none", "svg.hashsalt": "vjepa2-ac"}
    text = io.StringIO()
    with in_our_style(style), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)  # a reader's fonts have it
        figure = new_figure(width, height, layout="constrained")
        draw(figure, *given)
        FigureCanvasSVG(figure).print_svg(text, metadata={"Date": None})  # `savefig` would lay it out twice
    return f"data:image/svg+xml;base64,{base64.b64encode(text.getvalue().encode()).decode()}"


def visible(text: str) -> str:
    """Return a text without what a page or an image may not show."""
    return _HIDDEN.sub("\N{REPLACEMENT CHARACTER}", text)
