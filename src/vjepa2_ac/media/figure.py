"""Figures in one style: as PNG files, as pixels, as SVG for a page; and films of what a model imagines.

Every image of a film says what it is: recorded, what the simulator shows, decoded from the latents of a true frame, or
imagined.
"""

from __future__ import annotations

import base64
import io
import re
import textwrap
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

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


def headline(figure: Any, words: str, *, across: int = 150) -> None:
    """Write lines of text above a figure, whose layout makes room for them."""
    figure.suptitle(textwrap.fill(words, across), fontsize=10.5, x=0.01, ha="left")


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
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # it has been laid out: once is enough
        figure.savefig(text, format="svg", metadata={"Date": None})
    return f"data:image/svg+xml;base64,{base64.b64encode(text.getvalue().encode()).decode()}"


def visible(text: str) -> str:
    """Return a text without what a page or an image may not show."""
    return _HIDDEN.sub("\N{REPLACEMENT CHARACTER}", text)


Kind = Literal["recorded", "simulated", "decoded", "imagined", "error", "latents"]

MEANING: dict[Kind, tuple[str, str]] = {
    "recorded": (GREY, "recorded"),
    "simulated": (GREEN, "what really happens, simulated"),
    "decoded": (BLUE, "decoded from the true frame's latents"),
    "imagined": (ORANGE, "imagined from the first frame alone"),
    "error": (RED, "error of each patch: brighter is worse"),
    "latents": ("#7a4fa3", "latents as colours: alike if the latents are"),
}
"""Colour and meaning of each kind."""

_DOTS = 100  # per inch
_LABEL, _HEAD, _GAP, _LINE, _LEGEND = 170, 90, 14, 17, 270  # pixels
_MOST_COLUMNS = 9
_HOLD = 3  # how many times as long the first and the last frame of a video are shown


@dataclass(frozen=True, eq=False)
class StripRow:
    """Frames of one story, the first one at the start."""

    label: str
    kind: Kind  # of all frames, except for the first one of what is imagined: it is given, and decoded
    frames: UInt8[np.ndarray, "time height width 3"]
    captions: tuple[str, ...] = ()  # of each frame, in small letters; none: no line for them


@dataclass(frozen=True, eq=False)
class FilmStrip:
    """Rows of equal length."""

    title: str
    rows: tuple[StripRow, ...]
    seconds: tuple[float, ...]  # of each frame since the start


def spread_with_ends(size: int, count: int) -> list[int]:
    """Return at most `count` of `range(size)`, evenly spread, each once, the first and the last among them."""
    return sorted({round(place) for place in np.linspace(0, size - 1, min(size, count))})


def draw_strip(film: FilmStrip, *, side: int = 128) -> UInt8[np.ndarray, "height width 3"]:
    """Return all rows below each other, time from left to right; of many times some, evenly spread.

    Args:
        film: What is shown.
        side: Height and width of an image, in pixels, about.
    """
    places = spread_with_ends(len(film.seconds), _MOST_COLUMNS)
    captioned = sum(bool(row.captions) for row in film.rows)
    size = _LABEL + len(places) * (side + _GAP), _HEAD + len(film.rows) * (side + _GAP) + _LINE * captioned
    with _figure(film, size, title=film.title) as figure:
        grid = figure.subplots(len(film.rows), len(places), squeeze=False)
        for row, beside in zip(film.rows, grid, strict=True):
            for place, axes in zip(places, beside, strict=True):
                _show(axes, row, place)
            beside[0].set_ylabel(row.label, color=MEANING[row.kind][0], rotation=0, ha="right", va="center")
        for place, axes in zip(places, grid[0], strict=True):
            text = f"{film.seconds[place]:.2f} s" if place else "start, given"
            axes.set_title(text, fontsize=7, color=GREY, loc="left")
        return pixels_of(figure)


def film_frames(film: FilmStrip, *, side: int = 192, across: int = 4) -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
    """Yield an image of all rows side by side for each time.

    Args:
        film: What is shown.
        side: Height and width of an image, in pixels, about.
        across: Rows beside each other.
    """
    across = min(across, len(film.rows))
    down = -(-len(film.rows) // across)
    for place, seconds in enumerate(film.seconds):
        when = f"{seconds:.2f} s" if place else "start: all that is given"
        size = across * (side + _GAP), _HEAD + down * (side + 4 * _LINE)
        with _figure(film, size, title=f"{film.title}\n{when}") as figure:
            grid = figure.subplots(down, across, squeeze=False).flat
            for row, axes in zip(film.rows, grid, strict=False):
                _show(axes, row, place)
                axes.set_title(row.label, fontsize=8, color=MEANING[row.kind][0])
            for axes in grid:
                axes.set_axis_off()
            yield pixels_of(figure)


def durations(film: FilmStrip, *, slower: float = 1.0) -> list[float]:
    """Return how many seconds each frame of a video is shown: real time or slower, the first and last one longer."""
    steps = np.diff(film.seconds).tolist() or [1.0]
    shown = [slower * one for one in [*steps, steps[-1]]][: len(film.seconds)]
    shown[0] = max(shown[0], 0.5) * _HOLD
    shown[-1] = max(shown[-1], 0.5) * _HOLD
    return shown


def held(frames: Sequence[np.ndarray], seconds: Sequence[float], rate_hz: float) -> Iterator[np.ndarray]:
    """Yield each frame as often as a video of this rate needs to show it that long."""
    for frame, one in zip(frames, seconds, strict=True):
        for _ in range(max(1, round(one * rate_hz))):
            yield frame


@contextmanager
def _figure(film: FilmStrip, size: tuple[int, int], *, title: str) -> Iterator[Any]:
    """Yield a figure of a width and a height in pixels, with a title, and below it what the colours mean."""
    kinds = {row.kind for row in film.rows}
    shown = [kind for kind in MEANING if kind in kinds or (kind == "decoded" and "imagined" in kinds)]
    with in_our_style({"font.size": 8.5}):
        figure = new_figure(*(pixels / _DOTS for pixels in size), dpi=_DOTS, layout="compressed", facecolor="white")
        figure.suptitle(title, fontsize=10, weight="bold", x=0.01, ha="left")
        patches = [Patch(color=MEANING[kind][0], label=MEANING[kind][1]) for kind in shown]
        columns = max(1, size[0] // _LEGEND)
        figure.legend(handles=patches, loc="outside lower left", ncols=columns, fontsize=8, handlelength=1)
        yield figure


def show_framed(axes: Any, image: UInt8[np.ndarray, "height width 3"], kind: Kind) -> None:
    """Show an image in a frame of the colour of its kind."""
    axes.imshow(image)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(visible=True, color=MEANING[kind][0], linewidth=3)


def _show(axes: Any, row: StripRow, place: int) -> None:
    show_framed(axes, row.frames[place], "decoded" if row.kind == "imagined" and place == 0 else row.kind)
    if row.captions:
        axes.set_xlabel(row.captions[place] or " ", fontsize=7, color=GREY)


_CAPTION = 30  # pixels
_BETWEEN = 6


def side_by_side(
    pictures: Sequence[UInt8[np.ndarray, "height width 3"]], captions: Sequence[str], title: str, *, enlarged: int = 2
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return images of one size in a row, a caption above each, a title above all.

    Args:
        pictures: The images.
        captions: One for each.
        title: A line, at most as long as all images are wide.
        enlarged: Pixels per pixel, along both axes.
    """
    large = [picture.repeat(enlarged, axis=0).repeat(enlarged, axis=1) for picture in pictures]
    columns = [
        np.concatenate([_text_image(text, one.shape[1]), one]) for text, one in zip(captions, large, strict=True)
    ]
    gap = np.full((columns[0].shape[0], _BETWEEN, 3), 255, dtype=np.uint8)
    row = np.concatenate([part for column in columns for part in (column, gap)][:-1], axis=1)
    return np.concatenate([_text_image(title, row.shape[1], points=11.0), row])


@lru_cache(maxsize=512)
def _text_image(text: str, width: int, *, points: float = 9.0) -> UInt8[np.ndarray, "_ width 3"]:
    """Return a line of text on white; read only, since it is drawn once."""
    figure = new_figure(width / _DOTS, _CAPTION / _DOTS, dpi=_DOTS, facecolor="white")
    figure.text(8 / width, 0.5, text, fontsize=points, va="center", ha="left", parse_math=False)
    return pixels_of(figure)
