"""A film as one image: a row of panels for each row of the film, a column for each time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.media.image_file import encode_png
from vjepa2_ac.reports.figures.film.film import Film, FilmRow, even_columns
from vjepa2_ac.reports.figures.film.lettering import TextLine, fitted, lettered, text_width, wrapped
from vjepa2_ac.reports.figures.film.panels import (
    BORDER,
    COLOURS,
    GREY,
    Footer,
    Sheet,
    panel_size,
)
from vjepa2_ac.storage import write_atomically

MOST_COLUMNS = 9
_MARGIN, _GAP = 18, 8  # pixels, as below
_TITLE, _LABEL, _LINE = 38, 196, 20
_LARGE, _NORMAL, _SMALL = 15.0, 11.5, 10.0  # points: a strip is wide, and mostly seen smaller than it is
_LABEL_LINES, _CAPTION_LINES = 4, 3


def write_strip(film: Film, path: Path) -> Path:
    """Write a film as one PNG, atomically, and return its path."""
    write_atomically(path, encode_png(draw_strip(film), smallest=False))
    return path


def draw_strip(film: Film) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return a film as one RGB image; of more than `MOST_COLUMNS` columns some, evenly spread.

    Above each column: its time and, where the film has captions, the action that led to it. Below a row: its own
    captions, where it has any. The border's colour says what a frame is, the mark "given" which frames the model got.
    """
    layout = _Layout(film)
    sheet = Sheet.blank(layout.height, layout.width)
    sheet.lines.append(TextLine(fitted(film.title, layout.inner, _LARGE, "bold"), _MARGIN, 24, _LARGE, weight="bold"))
    _draw_header(sheet, layout)
    top = layout.header_end
    for row in film.rows:
        _draw_label(sheet, row, top, layout.panel[0])
        for place, column in enumerate(layout.columns):
            sheet.panel(row, column, top, layout.left(place))
            _draw_caption(sheet, layout, row.caption_at(column), place, top + layout.panel[0])
        top += layout.row_height(row)
    sheet.footer(layout.footer, top, _MARGIN)
    return lettered(sheet.pixels, sheet.lines)


@dataclass(frozen=True)
class _Layout:
    """Where things are on a strip, in pixels."""

    film: Film

    @cached_property
    def columns(self) -> tuple[int, ...]:
        return tuple(even_columns(self.film.columns, MOST_COLUMNS))

    @cached_property
    def panel(self) -> tuple[int, int]:
        return panel_size(self.film)

    @property
    def inner(self) -> int:
        """Width without margins, enough for the title."""
        panels = _LABEL + len(self.columns) * (self.panel[1] + _GAP) - _GAP
        return max(panels, min(1000, int(text_width(self.film.title, _LARGE, "bold")) + 2))

    @property
    def width(self) -> int:
        return self.inner + 2 * _MARGIN

    @cached_property
    def header_lines(self) -> list[list[str]]:
        """The captions of the shown columns, as lines."""
        if not self.film.captions:
            return [[] for _ in self.columns]
        return [self.caption_lines(self.film.captions[column]) for column in self.columns]

    @property
    def header_end(self) -> int:
        return _MARGIN + _TITLE + _LINE * (1 + max(map(len, self.header_lines))) + 2

    @cached_property
    def footer(self) -> Footer:
        notes = []
        if len(self.columns) < self.film.columns:
            between = "; the actions between them are not" if self.film.is_captioned else ""
            notes = [f"{len(self.columns)} of {self.film.columns} times are shown, evenly spread{between}."]
        return Footer.of(self.film, self.inner, points=_SMALL, line=_LINE, notes=notes)

    @property
    def height(self) -> int:
        rows = sum(map(self.row_height, self.film.rows))
        return self.header_end + rows + self.footer.height + _MARGIN

    def row_height(self, row: FilmRow) -> int:
        lines = max(len(self.caption_lines(row.caption_at(column))) for column in self.columns)
        return self.panel[0] + _LINE * lines + _GAP + 2 * bool(lines)

    def caption_lines(self, caption: str) -> list[str]:
        return wrapped(caption, self.panel[1], _SMALL, most=_CAPTION_LINES)

    def left(self, place: int) -> int:
        return _MARGIN + _LABEL + place * (self.panel[1] + _GAP)


def _draw_header(sheet: Sheet, layout: _Layout) -> None:
    for place, (column, lines) in enumerate(zip(layout.columns, layout.header_lines, strict=True)):
        left, middle = layout.left(place), _MARGIN + _TITLE + _LINE / 2 - 3
        sheet.lines.append(TextLine(f"{layout.film.seconds[column]:.2f} s", left, middle, _NORMAL, weight="bold"))
        for number, line in enumerate(lines, start=1):
            sheet.lines.append(TextLine(line, left, middle + _LINE * number, _SMALL, GREY))


def _draw_label(sheet: Sheet, row: FilmRow, top: int, panel_height: int) -> None:
    """Write a row's label and what it shows, beside the middle of its panels."""
    most = max(1, min(_LABEL_LINES, panel_height // _LINE - 1))
    lines = wrapped(row.label, _LABEL - 14, _NORMAL, most=most, weight="bold")
    middle = top + (panel_height - _LINE * len(lines)) / 2
    for number, line in enumerate(lines):
        sheet.lines.append(TextLine(line, _MARGIN, middle + _LINE * number, _NORMAL, weight="bold"))
    colour = GREY if row.kind == "difference" else COLOURS[row.kind]
    sheet.lines.append(TextLine(row.kind, _MARGIN, middle + _LINE * len(lines), _NORMAL, colour))


def _draw_caption(sheet: Sheet, layout: _Layout, caption: str, place: int, top: int) -> None:
    for number, line in enumerate(layout.caption_lines(caption)):
        middle = top + _LINE * number + _LINE / 2 + BORDER / 2
        sheet.lines.append(TextLine(line, layout.left(place), middle, _SMALL, GREY))
