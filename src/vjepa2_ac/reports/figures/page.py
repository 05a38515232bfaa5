"""Figures as PNG files in one style, and their layout: positions in inches from the top left."""

from __future__ import annotations

import base64
import io
import re
import textwrap
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
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


@dataclass(frozen=True, eq=False)
class Page:
    """A matplotlib figure with a size in inches."""

    figure: Any
    width: float
    height: float

    def axes(self, left: float, top: float, width: float, height: float) -> Any:
        """Return axes at this position."""
        return self.figure.add_axes(
            (left / self.width, 1 - (top + height) / self.height, width / self.width, height / self.height)
        )

    def text(self, left: float, top: float, words: str, **style: Any) -> None:
        """Write text with its top left corner at this position."""
        style = {"va": "top", "ha": "left", **style}
        self.figure.text(left / self.width, 1 - top / self.height, words, **style)

    def headline(self, words: str) -> None:
        """Write lines of text above a page of 13 inches, whose layout makes room for them."""
        self.figure.suptitle(textwrap.fill(words, 150), fontsize=10.5, x=0.01, ha="left")


@contextmanager
def written_page(
    path: Path, width: float, height: float, *, dpi: int, style: dict[str, Any], **options: Any
) -> Iterator[Page]:
    """Yield a page of so many inches to draw on, which is then written as PNG, atomically.

    Args:
        path: The file.
        width: In inches.
        height: Likewise.
        dpi: Pixels per inch.
        style: Settings of matplotlib beside those of all our figures.
        options: Of the figure.
    """
    with mpl.rc_context(_STYLE | style):
        page = Page(new_figure(width, height, **options), width, height)
        yield page
        with atomic_writer(path) as file:
            page.figure.savefig(file, format="png", dpi=dpi)


def new_figure(width: float, height: float, **options: Any) -> Figure:
    """Return a figure of so many inches with a canvas of its own: pyplot keeps figures, and may open windows."""
    figure = Figure(figsize=(width, height), **options)
    FigureCanvasAgg(figure)
    return figure


def svg_of(draw: Callable[[Any], None], width: float, height: float) -> str:
    """Return a figure of so many inches as SVG in a data: URL, in which nothing can run; always the same bytes."""
    style = {"font.size": 9, "legend.fontsize": 8, "svg.fonttype": "none", "svg.hashsalt": "vjepa2-ac"}
    text = io.StringIO()
    with mpl.rc_context(_STYLE | style), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)  # a reader's fonts have it
        figure = new_figure(width, height, layout="constrained")
        draw(figure)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # it has been laid out: once is enough
        figure.savefig(text, format="svg", metadata={"Date": None})
    return f"data:image/svg+xml;base64,{base64.b64encode(text.getvalue().encode()).decode()}"


def visible(text: str) -> str:
    """Return a text without what a page or an image may not show."""
    return _HIDDEN.sub("\N{REPLACEMENT CHARACTER}", text)
