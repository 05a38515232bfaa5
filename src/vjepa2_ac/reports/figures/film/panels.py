"""What strip and animation share: panels with a border in the colour of what they show, marks, notes, the legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from matplotlib.colors import to_rgb

from vjepa2_ac.media.enlarge import enlarged
from vjepa2_ac.reports.figures.film.difference import FULL_SCALE, heat_colours
from vjepa2_ac.reports.figures.film.film import Film, FilmRow, FrameKind
from vjepa2_ac.reports.figures.film.lettering import TextLine, text_width, wrapped

BORDER = 4  # pixels, as all below
GREY, INK = "#6f6f6f", "#222222"
SMALL, NORMAL, LARGE = 8.0, 9.0, 12.0  # points
LINE = 17  # height of a line of text
_PANEL = 256  # most pixels along a side to which small frames are enlarged
_SWATCH, _NEAR, _GAP = 12, 6, 22

COLOURS: dict[FrameKind, str] = {  # told apart by people who do not see red or green
    "recorded": "#4d4d4d", "simulated": "#009e73", "decoded": "#0072b2", "imagined": "#d55e00", "difference": "#c9c9c9",
}  # fmt: skip
_MEANINGS: dict[FrameKind, str] = {
    "recorded": "recorded by the camera",
    "simulated": "rendered by the simulator",
    "decoded": "decoded from a recorded frame's latents",
    "imagined": "imagined: decoded from predicted latents",
    "difference": f"difference of pixels: 0 to {FULL_SCALE} of 255",
}
_CAPTIONS_NOTE = "The text at a frame is the action that led to it; left and right are the robot's."
_NAMED: frozenset[FrameKind] = frozenset({"decoded", "imagined", "simulated"})
_MARK_SIDE, _MARK_HEIGHT = 5, 17


@dataclass(eq=False)
class Sheet:
    """A white canvas, and the text that will be on it."""

    pixels: UInt8[np.ndarray, "height width 3"]
    lines: list[TextLine]

    @classmethod
    def blank(cls, height: int, width: int) -> Sheet:
        """Return an empty sheet; sides are even, as videos need them."""
        return cls(np.full((height + height % 2, width + width % 2, 3), 255, dtype=np.uint8), [])

    @property
    def width(self) -> int:
        """In pixels."""
        return int(self.pixels.shape[1])

    def fill(self, top: int, left: int, size: tuple[int, int], colour: str) -> None:
        """Paint a rectangle of height and width."""
        self.pixels[top : top + size[0], left : left + size[1]] = np.round(255 * np.array(to_rgb(colour)))

    def panel(self, row: FilmRow, column: int, top: int, left: int, *, names_kind: bool = False) -> None:
        """Draw the frame of a row in a column with its border, and a mark if it was given; nothing if there is none.

        Args:
            row: Of the film.
            column: Of the film.
            top: Of the border.
            left: Likewise.
            names_kind: The mark also says what the frame is, unless a camera took it.
        """
        frame = row.frame_at(column)
        if frame is None:
            return
        large = enlarged(frame, enlargement(row.size))
        height, width, _ = large.shape
        colour = COLOURS[row.kind_at(column)]
        self.fill(top, left, (height + 2 * BORDER, width + 2 * BORDER), colour)
        self.pixels[top + BORDER : top + BORDER + height, left + BORDER : left + BORDER + width] = large
        named = names_kind and row.kind_at(column) in _NAMED
        mark = ", ".join(["given"] * row.is_given(column) + [row.kind_at(column)] * named)
        if mark:
            self.fill(top, left, (_MARK_HEIGHT, int(text_width(mark, SMALL, "bold")) + 2 * _MARK_SIDE), colour)
            self.lines.append(TextLine(mark, left + _MARK_SIDE, top + _MARK_HEIGHT / 2, SMALL, "white", "bold"))

    def footer(self, footer: Footer, top: int, left: int) -> None:
        """Draw what border colours mean, and notes."""
        middle = top + footer.line / 2
        for kinds in footer.legend:
            x = float(left)
            for kind in kinds:
                self._swatch(kind, int(middle) - _SWATCH // 2, int(x))
                words_at = x + _swatch_width(kind) + _NEAR
                self.lines.append(TextLine(_MEANINGS[kind], words_at, middle, footer.points, GREY))
                x += _entry_width(kind, footer.points)
            middle += footer.line
        for note in footer.notes:
            self.lines.append(TextLine(note, left, middle, footer.points, GREY))
            middle += footer.line

    def _swatch(self, kind: FrameKind, top: int, left: int) -> None:
        width = _swatch_width(kind)
        self.fill(top, left, (_SWATCH, width), COLOURS[kind])
        if kind == "difference":
            self.pixels[top : top + _SWATCH, left : left + width] = heat_colours(np.linspace(0, 1, width))


@dataclass(frozen=True)
class Footer:
    """What stands below the panels: legend and notes, as lines that fit."""

    legend: tuple[tuple[FrameKind, ...], ...]
    notes: tuple[str, ...]
    points: float
    line: int  # height of a line in pixels

    @classmethod
    def of(cls, film: Film, width: int, *, points: float, line: int, notes: Sequence[str] = ()) -> Footer:
        """Return the footer of a film in so many pixels; what texts at frames mean is its first note."""
        rows: list[tuple[FrameKind, ...]] = [()]
        for kind in film.kinds:
            longer = (*rows[-1], kind)
            if rows[-1] and sum(_entry_width(each, points) for each in longer) - _GAP > width:
                rows.append((kind,))
            else:
                rows[-1] = longer
        all_notes = [_CAPTIONS_NOTE, *notes] if film.is_captioned else notes
        return cls(
            tuple(rows),
            tuple(each for note in all_notes for each in wrapped(note, width, points, most=3)),
            points,
            line,
        )

    @property
    def height(self) -> int:
        """In pixels."""
        return self.line * (len(self.legend) + len(self.notes))


def _swatch_width(kind: FrameKind) -> int:
    return 60 if kind == "difference" else _SWATCH


def _entry_width(kind: FrameKind, points: float) -> float:
    return _swatch_width(kind) + _NEAR + text_width(_MEANINGS[kind], points) + _GAP


def enlargement(size: tuple[int, int]) -> int:
    """Return the whole factor by which frames of this height and width are enlarged."""
    return max(1, _PANEL // max(size))


def panel_size(film: Film) -> tuple[int, int]:
    """Return height and width of a panel, border included."""
    height, width = (enlargement(film.rows[0].size) * side + 2 * BORDER for side in film.rows[0].size)
    return height, width
