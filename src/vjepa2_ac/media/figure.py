"""Figures in a common style (PNG files, pixels, SVG), and image strips and videos of predicted frames.

The colour of the border around an image shows the kind of the image: recorded, simulated, decoded from the latents of a
true frame, or predicted by a model.
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

# Characters that are invalid in a page or an image, or could mislead a reader: control characters, lone surrogates,
# noncharacters, and marks that change the direction of text.
_HIDDEN = re.compile("[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u202a-\\u202e\\u2066-\\u2069\\ud800-\\udfff\\ufffe\\uffff]")
GREY, BLUE, ORANGE, GREEN, RED = "#8a8a8a", "#1f6fb4", "#d1762a", "#2b8a3e", "#b3246b"
_PURPLE = "#6b4fa0"
_STYLE = {
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 9,
    "legend.frameon": False,
    "text.parse_math": False,  # dollar signs in names from the user are shown literally
}


def add_title(figure: Any, title: str) -> None:
    """Write a title of one line above a figure, truncated to the width of the figure."""
    line = textwrap.shorten(title, int(12 * figure.get_figwidth()), placeholder=" …")  # 12 letters per inch
    figure.suptitle(line, fontsize=10.5, x=0.01, ha="left")


@contextmanager
def save_figure(
    path: Path, width: float, height: float, *, dpi: int = 100, size: float = 8, **options: Any
) -> Iterator[Any]:
    """Yield a figure to draw on, and write it atomically as a PNG file when the block ends.

    Args:
        path: The file.
        width: Width of the figure in inches.
        height: Height of the figure in inches.
        dpi: Pixels per inch.
        size: Font size in points.
        options: Further arguments of matplotlib's `Figure`.
    """
    with figure_style({"font.size": size}):
        figure = new_figure(width, height, **{"layout": "constrained", **options})
        yield figure
        with atomic_writer(path) as file:
            figure.savefig(file, format="png", dpi=dpi)


def figure_style(changes: dict[str, Any]) -> AbstractContextManager[None]:
    """Return a context in which matplotlib draws in the style of this package, with some rc parameters changed."""
    return mpl.rc_context(_STYLE | changes)


def figure_to_pixels(figure: Any) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a figure and return its RGB pixels."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()


def new_figure(width: float, height: float, **options: Any) -> Figure:
    """Return a figure (size in inches) with a canvas.

    Pyplot is not used, because it keeps all figures in memory and may open windows.
    """
    figure = Figure(figsize=(width, height), **options)
    FigureCanvasAgg(figure)
    return figure


def figure_to_svg(draw: Callable[..., None], width: float, height: float, *arguments: Any) -> str:
    """Call `draw(figure, *arguments)` on a figure (size in inches), and return it as a `data:` URL of SVG.

    Equal figures give equal URLs.
    """
    style = {"font.size": 9, "legend.fontsize": 8, "svg.fonttype": "none", "svg.hashsalt": "vjepa2-ac"}
    text = io.StringIO()
    with figure_style(style), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)  # browsers have the glyph
        figure = new_figure(width, height, layout="constrained")
        draw(figure, *arguments)
        FigureCanvasSVG(figure).print_svg(text, metadata={"Date": None})  # `savefig` would compute the layout twice
    return f"data:image/svg+xml;base64,{base64.b64encode(text.getvalue().encode()).decode()}"


def replace_hidden_characters(text: str) -> str:
    """Return a text with invalid and misleading characters replaced by U+FFFD."""
    return _HIDDEN.sub("\N{REPLACEMENT CHARACTER}", text)


# ---- image strips and videos of rollouts ----

Pixels = UInt8[np.ndarray, "_ _ 3"]
FrameKind = Literal["recorded", "simulated", "decoded", "predicted_base", "predicted", "error"]

FRAME_KINDS: dict[FrameKind, tuple[str, str]] = {
    "recorded": (GREY, "ground truth, recorded"),
    "simulated": (GREEN, "ground truth, simulated"),
    "decoded": (_PURPLE, "decoded from the true frame's latents"),
    "predicted_base": (ORANGE, "predicted by the base model"),
    "predicted": (BLUE, "predicted by the evaluated model"),
    "error": (RED, "error of each patch (brighter: larger error)"),
}
"""The colour and the legend text of each kind of frame. Plots show the models in the same colours."""

_PREDICTED = {"predicted_base", "predicted"}
_DPI = 100  # pixels per inch
_LABEL, _SEQUENCE, _HEAD, _GAP, _LINE, _LEGEND = 160, 90, 90, 14, 17, 270  # sizes of parts of a figure in pixels
_MAX_COLUMNS = 6  # with more columns the images are too small on a page that is 800 pixels wide
_PREVIEW_S, _START_S, _END_S = 1.2, 0.8, 0.8  # durations of the first image of a loop, the start and the end
_MAX_LOOP_S = 6.0
_SLOWDOWN = 2.0  # a loop plays at half the real speed


@dataclass(frozen=True, eq=False)
class StripRow:
    """One row of a strip: the frames of one rollout by one model, from the start frame on."""

    label: str  # the source of the frames: the model, or the simulator
    kind: FrameKind  # kind of all frames; the first frame of a predicted row is the decoded start frame
    frames: UInt8[np.ndarray, "time height width 3"]
    captions: tuple[str, ...] = ()  # one caption per frame, in small letters; empty: no captions
    sequence: str = ""  # name of the action sequence, if the strip has several
    outlines: Bool[np.ndarray, "time height width"] | None = None  # true mask of the arm, drawn as an outline


@dataclass(frozen=True, eq=False)
class RolloutStrip:
    """Rollouts of equal length, to be drawn as an image strip or a video."""

    title: str
    rows: tuple[StripRow, ...]
    seconds: tuple[float, ...]  # time of each frame since the start
    source: str = ""  # model and clip, in small letters

    @property
    def outline_legend(self) -> str:
        """The legend of the outlines; empty if no row has outlines."""
        return "; white outline: the true arm" * any(row.outlines is not None for row in self.rows)


def draw_strip(strip: RolloutStrip, *, side: int = 116) -> Pixels:
    """Draw the rows of a strip, with up to six evenly spaced times from left to right, and return the pixels.

    Args:
        strip: The rollouts.
        side: Approximate height and width of an image, in pixels.
    """
    columns = min(len(strip.seconds), _MAX_COLUMNS)
    num_captioned = sum(bool(row.captions) for row in strip.rows)
    size = _LABEL + columns * (side + _GAP), _HEAD + len(strip.rows) * (side + _GAP) + _LINE * num_captioned
    kinds = {row.kind for row in strip.rows} | {"decoded" for row in strip.rows if row.kind in _PREDICTED}
    patches = [Patch(color=colour, label=text) for kind, (colour, text) in FRAME_KINDS.items() if kind in kinds]
    with _figure(strip, size) as figure:
        legend = {"ncols": max(1, size[0] // _LEGEND), "fontsize": 8, "handlelength": 1, "alignment": "left"}
        figure.legend(
            handles=patches,
            loc="outside lower left",
            title=strip.source + strip.outline_legend or None,
            title_fontsize=7,
            **legend,
        )
        draw_rows(figure, strip)
        return figure_to_pixels(figure)


def draw_rows(figure: Any, strip: RolloutStrip) -> None:
    """Draw the rows of a strip on a figure or subfigure."""
    indices = np.unique(np.linspace(0, len(strip.seconds) - 1, _MAX_COLUMNS).round().astype(int)).tolist()
    grid = figure.subplots(len(strip.rows), len(indices), squeeze=False)
    for row, row_axes in zip(strip.rows, grid, strict=True):
        for index, axes in zip(indices, row_axes, strict=True):
            _show(axes, row, index)
        label = f"{row.label}:\n{row.sequence}" if row.sequence else row.label
        row_axes[0].set_ylabel(label, color=FRAME_KINDS[row.kind][0], rotation=0, ha="right", va="center")
    for index, axes in zip(indices, grid[0], strict=True):
        text = f"{strip.seconds[index]:.2f} s" if index else "input frame"
        axes.set_title(text, fontsize=8, color=GREY, loc="left")


def render_frames(strip: RolloutStrip, *, side: int = 172) -> Iterator[Pixels]:
    """Yield a video frame for each time: a grid of models and action sequences, the longer list horizontally.

    Args:
        strip: The rollouts.
        side: Approximate height and width of an image, in pixels.
    """
    sequences = dict.fromkeys(row.sequence for row in strip.rows)
    labels = dict.fromkeys(row.label for row in strip.rows)
    row_names, column_names = sorted((list(sequences), list(labels)), key=len)
    cells = {names: row for row in strip.rows for names in ((row.sequence, row.label), (row.label, row.sequence))}
    for index, seconds in enumerate(strip.seconds):
        caption = f"{seconds:.2f} s after the input frame" if index else "input frame"
        size = _SEQUENCE + len(column_names) * (side + _GAP), _HEAD + len(row_names) * (side + _GAP)
        with _figure(strip, size) as figure:
            figure.supxlabel(caption + strip.outline_legend, fontsize=9, x=0.01, ha="left")
            grid = figure.subplots(len(row_names), len(column_names), squeeze=False)
            for row_name, row_axes in zip(row_names, grid, strict=True):
                for column_name, axes in zip(column_names, row_axes, strict=True):
                    if (row := cells.get((row_name, column_name))) is None:
                        axes.set_axis_off()
                    else:
                        _show(axes, row, index)
                row_axes[0].set_ylabel(row_name.replace(", ", ",\n"), rotation=0, ha="right", va="center")
            for column_name, axes in zip(column_names, grid[0], strict=True):
                axes.set_title(column_name, fontsize=9.5)
            yield figure_to_pixels(figure)


def schedule_loop(strip: RolloutStrip) -> list[tuple[int, float]]:
    """Return (frame index, duration in seconds) of each frame of an endless loop.

    The last frame is shown first, because previews show the first frame of a loop. Then all frames follow from the
    start, at half the real speed, or faster if the loop would be longer than 6 s.
    """
    last = len(strip.seconds) - 1
    max_step_s = (_MAX_LOOP_S - _PREVIEW_S - _START_S - _END_S) / max(last - 1, 1)
    durations = [min(_SLOWDOWN * step_s, max_step_s) for step_s in np.diff(strip.seconds).tolist()]
    return [(last, _PREVIEW_S), (0, _START_S), *zip(range(1, last), durations, strict=False), (last, _END_S)]


@contextmanager
def _figure(strip: RolloutStrip, size: tuple[int, int]) -> Iterator[Any]:
    """Yield a figure with a size of (width, height) in pixels and with the title of the strip."""
    with figure_style({"font.size": 9}):
        figure = new_figure(*(pixels / _DPI for pixels in size), dpi=_DPI, layout="compressed", facecolor="white")
        figure.suptitle(strip.title, fontsize=11, weight="bold", x=0.01, ha="left")
        yield figure


def show_with_border(axes: Any, image: UInt8[np.ndarray, "height width 3"], kind: FrameKind) -> None:
    """Show an image with a border in the colour of its kind."""
    axes.imshow(image)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(visible=True, color=FRAME_KINDS[kind][0], linewidth=3)


def _show(axes: Any, row: StripRow, index: int) -> None:
    show_with_border(axes, row.frames[index], "decoded" if row.kind in _PREDICTED and index == 0 else row.kind)
    if row.outlines is not None and row.outlines[index].any():
        for colour, width in (("black", 2.2), ("white", 1.2)):
            axes.contour(row.outlines[index], [0.5], colors=colour, linewidths=width)
    if row.captions:
        axes.set_xlabel(row.captions[index] or " ", fontsize=7, color=GREY)


def colour_errors(
    errors: Float[np.ndarray, "grid grid"], size: tuple[int, int], worst: float = 1.0
) -> Float[np.ndarray, "height width 3"]:
    """Return patch errors as RGB colours from 0 to 255, from black (no error) to bright yellow (`worst` or more)."""
    colours = 255 * colormaps["inferno"](np.nan_to_num(errors / max(worst, 1e-12)))[..., :3]
    rows, columns = (np.arange(side) * len(errors) // side for side in size)
    return np.asarray(colours[rows][:, columns])


_CAPTION, _BETWEEN = 30, 6  # height of a caption and width of the gap between images, in pixels


def stack_horizontally(
    images: Sequence[Pixels], captions: Sequence[str], title: str = "", *, enlarged: int = 2
) -> Pixels:
    """Join images of one size horizontally, with a caption above each and a title above all.

    Args:
        images: The images.
        captions: One caption per image.
        title: One line, at most as wide as all images together; empty: no title.
        enlarged: Integer scale factor of both axes.
    """
    large = [image.repeat(enlarged, axis=0).repeat(enlarged, axis=1) for image in images]
    columns = [
        np.concatenate([_text_image(text, image.shape[1]), image]) for text, image in zip(captions, large, strict=True)
    ]
    gap = np.full((columns[0].shape[0], _BETWEEN, 3), 255, dtype=np.uint8)
    row = np.concatenate([part for column in columns for part in (column, gap)][:-1], axis=1)
    return np.concatenate([_text_image(title, row.shape[1], points=11.0), row]) if title else row


def stack_vertically(images: Sequence[Pixels]) -> Pixels:
    """Join images vertically; narrower images are padded with white on the right."""
    width = max(image.shape[1] for image in images)
    padding = [np.full((image.shape[0], width - image.shape[1], 3), 255, np.uint8) for image in images]
    return np.concatenate([np.concatenate(pair, axis=1) for pair in zip(images, padding, strict=True)])


@lru_cache(maxsize=512)
def _text_image(text: str, width: int, *, points: float = 9.0) -> UInt8[np.ndarray, "_ width 3"]:
    """Return an image of one line of text on white; callers must not modify it, because it is cached."""
    figure = new_figure(width / _DPI, _CAPTION / _DPI, dpi=_DPI, facecolor="white")
    figure.text(8 / width, 0.5, text, fontsize=points, va="center", ha="left", parse_math=False)
    return figure_to_pixels(figure)
