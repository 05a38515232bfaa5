"""Figures in one style: as PNG files, as pixels, and as SVG for a page; and films of what a model imagines.

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
from jaxtyping import Bool, Float, UInt8
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
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


# ---- films ----

Pixels = UInt8[np.ndarray, "_ _ 3"]
Kind = Literal["recorded", "simulated", "decoded", "imagined", "error"]

MEANING: dict[Kind, tuple[str, str]] = {
    "recorded": (GREY, "recorded"),
    "simulated": (GREEN, "what really happens, simulated"),
    "decoded": (BLUE, "decoded from the true frame's latents"),
    "imagined": (ORANGE, "imagined from the first frame alone"),
    "error": (RED, "error of each patch: brighter is worse"),
}
"""Colour and meaning of each kind."""

_DOTS = 100  # per inch
_LABEL, _STORY, _HEAD, _GAP, _LINE, _LEGEND = 160, 90, 90, 14, 17, 270  # pixels
_MOST_COLUMNS = 6  # that can be read where 800 pixels are as wide as a page
_PREVIEW_S, _START_S, _END_S, _LOOP_S = 1.2, 0.8, 0.8, 6.0  # how long a loop shows them; all of it, at most
_SLOWER = 2.0  # than reality, so that an eye can follow


@dataclass(frozen=True, eq=False)
class StripRow:
    """Frames of one story by one teller, the first one at the start."""

    label: str  # who tells: what really happens, the base, ...
    kind: Kind  # of all frames, except for the first one of what is imagined: it is given, and decoded
    frames: UInt8[np.ndarray, "time height width 3"]
    captions: tuple[str, ...] = ()  # of each frame, in small letters; none: no line for them
    story: str = ""  # the actions, where several are told
    outlines: Bool[np.ndarray, "time height width"] | None = None  # where the arm really is; None: nobody knows


@dataclass(frozen=True, eq=False)
class FilmStrip:
    """Rows of equal length."""

    title: str
    rows: tuple[StripRow, ...]
    seconds: tuple[float, ...]  # of each frame since the start
    source: str = ""  # model and clip, in small letters

    @property
    def about_outlines(self) -> str:
        """What the outlines mean, if there are any."""
        return "; white line: where the arm really is" * any(row.outlines is not None for row in self.rows)


def draw_strip(film: FilmStrip, *, side: int = 116) -> Pixels:
    """Return all rows below each other, time from left to right; of many times some, evenly spread.

    Args:
        film: What is shown.
        side: Height and width of an image, in pixels, about.
    """
    columns = min(len(film.seconds), _MOST_COLUMNS)
    captioned = sum(bool(row.captions) for row in film.rows)
    size = _LABEL + columns * (side + _GAP), _HEAD + len(film.rows) * (side + _GAP) + _LINE * captioned
    kinds = {row.kind for row in film.rows} | {"decoded" for row in film.rows if row.kind == "imagined"}
    patches = [Patch(color=colour, label=meaning) for kind, (colour, meaning) in MEANING.items() if kind in kinds]
    with _figure(film, size) as figure:
        legend = {"ncols": max(1, size[0] // _LEGEND), "fontsize": 8, "handlelength": 1, "alignment": "left"}
        figure.legend(
            handles=patches,
            loc="outside lower left",
            title=film.source + film.about_outlines or None,
            title_fontsize=7,
            **legend,
        )
        draw_rows(figure, film)
        return pixels_of(figure)


def draw_rows(figure: Any, film: FilmStrip) -> None:
    """Draw the rows of a strip on a figure, or on a part of one."""
    places = np.unique(np.linspace(0, len(film.seconds) - 1, _MOST_COLUMNS).round().astype(int)).tolist()
    grid = figure.subplots(len(film.rows), len(places), squeeze=False)
    for row, beside in zip(film.rows, grid, strict=True):
        for place, axes in zip(places, beside, strict=True):
            _show(axes, row, place)
        label = f"{row.label}:\n{row.story}" if row.story else row.label
        beside[0].set_ylabel(label, color=MEANING[row.kind][0], rotation=0, ha="right", va="center")
    for place, axes in zip(places, grid[0], strict=True):
        text = f"{film.seconds[place]:.2f} s" if place else "start, given"
        axes.set_title(text, fontsize=8, color=GREY, loc="left")


def film_frames(film: FilmStrip, *, side: int = 172) -> Iterator[Pixels]:
    """Yield an image for each time: a table of stories and tellers, of which there are more across than down.

    Args:
        film: What is shown.
        side: Height and width of an image, in pixels, about.
    """
    stories, tellers = dict.fromkeys(row.story for row in film.rows), dict.fromkeys(row.label for row in film.rows)
    down, across = sorted((list(stories), list(tellers)), key=len)
    cells = {names: row for row in film.rows for names in ((row.story, row.label), (row.label, row.story))}
    for place, seconds in enumerate(film.seconds):
        when = f"{seconds:.2f} s after the only frame that is given" if place else "the start: all that is given"
        size = _STORY + len(across) * (side + _GAP), _HEAD + len(down) * (side + _GAP)
        with _figure(film, size) as figure:
            figure.supxlabel(when + film.about_outlines, fontsize=9, x=0.01, ha="left")
            grid = figure.subplots(len(down), len(across), squeeze=False)
            for name, beside in zip(down, grid, strict=True):
                for other, axes in zip(across, beside, strict=True):
                    if (row := cells.get((name, other))) is None:
                        axes.set_axis_off()
                    else:
                        _show(axes, row, place)
                beside[0].set_ylabel(name.replace(", ", ",\n"), rotation=0, ha="right", va="center")
            for other, axes in zip(across, grid[0], strict=True):
                axes.set_title(other, fontsize=9.5)
            yield pixels_of(figure)


def loop_of(film: FilmStrip) -> list[tuple[int, float]]:
    """Return the times of a film in the order of a loop, each with the seconds for which it is shown.

    The end comes first, since that is what a preview shows; then all from the start, in real time or slower, but so
    that the loop is short.
    """
    last = len(film.seconds) - 1
    room = (_LOOP_S - _PREVIEW_S - _START_S - _END_S) / max(last - 1, 1)
    steps = [min(_SLOWER * step, room) for step in np.diff(film.seconds).tolist()]
    return [(last, _PREVIEW_S), (0, _START_S), *zip(range(1, last), steps, strict=False), (last, _END_S)]


@contextmanager
def _figure(film: FilmStrip, size: tuple[int, int]) -> Iterator[Any]:
    """Yield a figure of a width and a height in pixels, with the title of a film."""
    with in_our_style({"font.size": 9}):
        figure = new_figure(*(pixels / _DOTS for pixels in size), dpi=_DOTS, layout="compressed", facecolor="white")
        figure.suptitle(film.title, fontsize=11, weight="bold", x=0.01, ha="left")
        yield figure


def show_framed(axes: Any, image: UInt8[np.ndarray, "height width 3"], kind: Kind) -> None:
    """Show an image in a frame of the colour of its kind."""
    axes.imshow(image)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(visible=True, color=MEANING[kind][0], linewidth=3)


def _show(axes: Any, row: StripRow, place: int) -> None:
    show_framed(axes, row.frames[place], "decoded" if row.kind == "imagined" and place == 0 else row.kind)
    if row.outlines is not None and row.outlines[place].any():
        for colour, width in (("black", 2.2), ("white", 1.2)):
            axes.contour(row.outlines[place], [0.5], colors=colour, linewidths=width)
    if row.captions:
        axes.set_xlabel(row.captions[place] or " ", fontsize=7, color=GREY)


def error_colours(
    errors: Float[np.ndarray, "grid grid"], size: tuple[int, int], worst: float = 1.0
) -> Float[np.ndarray, "height width 3"]:
    """Return the errors of patches as colours from 0 to 255: from black, no error, to bright yellow, the worst one."""
    colours = 255 * colormaps["inferno"](np.nan_to_num(errors / max(worst, 1e-12)))[..., :3]
    rows, columns = (np.arange(side) * len(errors) // side for side in size)
    return np.asarray(colours[rows][:, columns])


_CAPTION = 30  # pixels
_BETWEEN = 6


def side_by_side(images: Sequence[Pixels], captions: Sequence[str], title: str = "", *, enlarged: int = 2) -> Pixels:
    """Return images of one size in a row, a caption above each, a title above all.

    Args:
        images: The images.
        captions: One for each.
        title: A line, at most as long as all images are wide; empty: none.
        enlarged: Pixels per pixel, along both axes.
    """
    large = [picture.repeat(enlarged, axis=0).repeat(enlarged, axis=1) for picture in images]
    columns = [
        np.concatenate([_text_image(text, one.shape[1]), one]) for text, one in zip(captions, large, strict=True)
    ]
    gap = np.full((columns[0].shape[0], _BETWEEN, 3), 255, dtype=np.uint8)
    row = np.concatenate([part for column in columns for part in (column, gap)][:-1], axis=1)
    return np.concatenate([_text_image(title, row.shape[1], points=11.0), row]) if title else row


def below_each_other(pictures: Sequence[Pixels]) -> Pixels:
    """Return images of any sizes below each other; what is narrower than another has white beside it."""
    width = max(picture.shape[1] for picture in pictures)
    beside = [np.full((picture.shape[0], width - picture.shape[1], 3), 255, np.uint8) for picture in pictures]
    return np.concatenate([np.concatenate(pair, axis=1) for pair in zip(pictures, beside, strict=True)])


@lru_cache(maxsize=512)
def _text_image(text: str, width: int, *, points: float = 9.0) -> UInt8[np.ndarray, "_ width 3"]:
    """Return a line of text on white; read only, since it is drawn once."""
    figure = new_figure(width / _DOTS, _CAPTION / _DOTS, dpi=_DOTS, facecolor="white")
    figure.text(8 / width, 0.5, text, fontsize=points, va="center", ha="left", parse_math=False)
    return pixels_of(figure)
