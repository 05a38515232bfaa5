"""A film as an animation: its rows as panels side by side, one image for each time; MP4 or GIF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.media.gif_writer import write_gif
from vjepa2_ac.media.video_writer import write_video
from vjepa2_ac.reports.figures.film.film import Film, FilmRow
from vjepa2_ac.reports.figures.film.lettering import TextLine, fitted, lettered, wrapped
from vjepa2_ac.reports.figures.film.panels import (
    COLOURS,
    GREY,
    LARGE,
    LINE,
    NORMAL,
    SMALL,
    Footer,
    Sheet,
    panel_size,
)

_MARGIN, _GAP, _TITLE = 16, 12, 24  # pixels
_LEAST_WIDTH = 460  # of the image, for title and legend
_MOST_ACROSS = 4
_FIRST_S, _LAST_S = 1.0, 1.5  # how long the first and the last time are held
_LEAST_S = 0.4  # and each other one: eyes need it; the time within the film is written in it
_RATE_HZ = 20.0  # of the MP4


def write_animation(film: Film, path: Path) -> Path:
    """Write a film as MP4 or as a GIF that repeats, by the name's ending, atomically; return its path.

    Raises:
        InputError: It is an MP4, and PyAV is not installed.
        ValueError: The name ends in neither .mp4 nor .gif.
    """
    if path.suffix not in {".mp4", ".gif"}:
        raise ValueError(f"{path}: an animation is a .mp4 or a .gif")
    frames, durations = film_frames(film), film_durations_s(film)
    if path.suffix == ".gif":
        return write_gif(path, frames, durations)
    repeated = (
        frame
        for frame, duration in zip(frames, durations, strict=True)
        for _ in range(max(1, round(_RATE_HZ * duration)))
    )
    return write_video(path, repeated, rate_hz=_RATE_HZ)


def film_durations_s(film: Film) -> list[float]:
    """Return how long each image of the animation is shown: real time, but no shorter than eyes need."""
    times = film.seconds[: film.columns]
    steps = [max(_LEAST_S, later - earlier) for earlier, later in pairwise(times)]
    durations = [*steps, _LAST_S]
    durations[0] = max(durations[0], _FIRST_S)
    return durations


def film_frames(film: Film) -> list[UInt8[np.ndarray, "_ _ 3"]]:
    """Return the images of the animation, one for each time of the film, all of one size.

    A row that begins later or ends earlier shows its first or its last frame, pale, so that nothing jumps.
    """
    layout = _Layout(film)
    return [_draw(layout, column) for column in range(film.columns)]


@dataclass(frozen=True)
class _Layout:
    """Where things are in an image of the animation, in pixels."""

    film: Film

    @cached_property
    def across(self) -> int:
        """The number of panels side by side: all of up to three, else as many as leave the fewest empty places."""
        count = len(self.film.rows)
        if count <= 3:
            return count
        return min(range(2, _MOST_ACROSS + 1), key=lambda across: (-count % across, abs(across - 3)))

    @cached_property
    def panel(self) -> tuple[int, int]:
        return panel_size(self.film)

    @property
    def inner(self) -> int:
        return max(self.across * (self.panel[1] + _GAP) - _GAP, _LEAST_WIDTH)

    @cached_property
    def title(self) -> list[str]:
        return wrapped(self.film.title, self.inner, LARGE, most=2, weight="bold")

    @cached_property
    def labels(self) -> list[list[str]]:
        """The label of each row, as lines."""
        return [wrapped(row.label, self.panel[1], NORMAL, most=2, weight="bold") for row in self.film.rows]

    @cached_property
    def label_height(self) -> int:
        return LINE * max(map(len, self.labels))

    @cached_property
    def below(self) -> int:
        """Height of the text below a panel."""
        return LINE if any(any(row.captions or ()) for row in self.film.rows) else 0

    @cached_property
    def footer(self) -> Footer:
        return Footer.of(self.film, self.inner, points=SMALL, line=LINE)

    @property
    def times_top(self) -> int:
        """Where the line of time and action begins."""
        return _MARGIN + _TITLE * len(self.title) + 4

    @property
    def top(self) -> int:
        """Where the first row of panels begins: below the title, and time and action."""
        return self.times_top + LINE + 6

    @property
    def panel_row(self) -> int:
        return self.label_height + self.panel[0] + self.below + _GAP

    def place(self, number: int) -> tuple[int, int]:
        """Top and left of what belongs to a row of the film."""
        down, across = divmod(number, self.across)
        return self.top + down * self.panel_row, _MARGIN + across * (self.panel[1] + _GAP)

    @property
    def footer_top(self) -> int:
        return self.top + -(-len(self.film.rows) // self.across) * self.panel_row

    def blank(self) -> Sheet:
        return Sheet.blank(self.footer_top + self.footer.height + _MARGIN // 2, self.inner + 2 * _MARGIN)


def _draw(layout: _Layout, column: int) -> UInt8[np.ndarray, "_ _ 3"]:
    film, sheet = layout.film, layout.blank()
    for number, line in enumerate(layout.title):
        sheet.lines.append(TextLine(line, _MARGIN, _MARGIN + 10 + _TITLE * number, LARGE, weight="bold"))
    middle = layout.times_top + LINE / 2
    sheet.lines.append(TextLine(f"{film.seconds[column]:.2f} s", _MARGIN, middle, NORMAL, weight="bold"))
    caption = film.captions[column] if film.captions else ""
    sheet.lines.append(TextLine(fitted(caption, layout.inner - 64, NORMAL), _MARGIN + 64, middle, NORMAL, GREY))
    for number, row in enumerate(film.rows):
        _draw_row(sheet, layout, row, number, column)
    sheet.footer(layout.footer, layout.footer_top, _MARGIN)
    return lettered(sheet.pixels, sheet.lines)


def _draw_row(sheet: Sheet, layout: _Layout, row: FilmRow, number: int, column: int) -> None:
    top, left = layout.place(number)
    height, width = layout.panel
    colour = GREY if row.kind == "difference" else COLOURS[row.kind]
    panel_top = top + layout.label_height
    for line_number, line in enumerate(reversed(layout.labels[number])):  # the last one at the panel
        sheet.lines.append(TextLine(line, left, panel_top - LINE * (line_number + 0.5) - 2, NORMAL, colour, "bold"))
    shown = min(max(column, row.start), row.end - 1)
    sheet.panel(row, shown, panel_top, left, names_kind=True)
    if shown != column:
        area = sheet.pixels[panel_top : panel_top + height, left : left + width]
        area[:] = 255 - (255 - area) // 4
    middle = panel_top + height + LINE / 2
    sheet.lines.append(TextLine(fitted(row.caption_at(column), width, SMALL), left, middle, SMALL, GREY))
