"""Charts as SVG in the page's colours, light or dark: lines, bands, dots, axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from markupsafe import Markup

from vjepa2_ac.reports.html.formatting import decimal
from vjepa2_ac.reports.html.templates import render

_TINY = 1e-4  # steps below it are written with an exponent
_MOST_MARKED = 40  # points; a line of more has no markers


@dataclass(frozen=True)
class Line:
    """One curve. Values that are not finite are gaps."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    style: str  # a class of the page's style sheet for colour and dashes
    low: Sequence[float] | None = None  # of the band; None: there is none
    high: Sequence[float] | None = None


@dataclass(frozen=True)
class Axis:
    """The label and range of an axis."""

    label: str
    low: float
    high: float
    ticks: tuple[float, ...]
    shown: tuple[str, ...]  # text at each tick


def nice_axis(label: str, values: Sequence[float], *, most: int = 6, from_zero: bool = False) -> Axis:
    """Return an axis with round ticks whose range holds all finite values."""
    finite = [value for value in values if math.isfinite(value)] or [0.0, 1.0]
    low, high = min(finite), max(finite)
    low = min(low, 0.0) if from_zero else low
    if high - low < 1e-12:
        low, high = low - (0.5 if low else 0.0), high + 0.5
    step = _nice_step((high - low) / most)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    ticks = tuple(number * step for number in range(first, last + 1))
    return Axis(label, first * step, last * step, ticks, _written(ticks, step))


def axis_at(label: str, values: Sequence[float], shown: Sequence[str], *, most: int = 8) -> Axis:
    """Return an axis whose ticks are values themselves, all or every n-th, with a small margin at both ends."""
    every = -(-len(values) // most)
    air = 0.04 * (values[-1] - values[0]) or 0.5
    return Axis(label, values[0] - air, values[-1] + air, tuple(values[::every]), tuple(shown[::every]))


def line_chart(
    description: str,
    lines: Sequence[Line],
    x_axis: Axis,
    y_axis: Axis,
    *,
    level: float | None = None,
    key: Sequence[Line] = (),
) -> Markup:
    """Return curves as SVG, and below them their legend.

    Args:
        description: Description of the chart, as alternative text.
        lines: Later ones are drawn on top.
        x_axis: The horizontal axis.
        y_axis: The vertical axis; values outside are clipped.
        level: Height of a horizontal reference line.
        key: What the legend names; empty: there is none.
    """
    place = _Place(x_axis, y_axis)
    references = [] if level is None else [place.horizontal(level, "level")]
    drawn = {"lines": lines, "connected": True, "most_marked": _MOST_MARKED, "references": references, "key": key}
    return render("chart", description=description, place=place, **drawn)


def dot_chart(description: str, lines: Sequence[Line], x_axis: Axis, y_axis: Axis) -> Markup:
    """Return a scatter chart, with the diagonal of equal values, and zero lines.

    Args:
        description: Description of the chart, as alternative text.
        lines: The points; later ones are drawn on top.
        x_axis: The horizontal axis.
        y_axis: The vertical axis, zero included.
    """
    place = _Place(x_axis, y_axis)
    ends = (max(x_axis.low, y_axis.low), min(x_axis.high, y_axis.high))
    diagonal = Line("", [place.across(end) for end in ends], [place.down(end) for end in ends], "level")
    drawn = {"lines": lines, "connected": False, "references": [place.horizontal(0.0, "axis"), diagonal], "key": ()}
    return render("chart", description=description, place=place, **drawn)


def _written(ticks: Sequence[float], step: float) -> tuple[str, ...]:
    """Return the shortest exact tick labels: 0.25, 150k, 7.5e-5."""
    largest = max(abs(tick) for tick in ticks)
    scale, suffix = next(
        ((scale, suffix) for scale, suffix in ((1e9, "G"), (1e6, "M"), (1e3, "k")) if largest >= max(scale, 1e5)),
        (1.0, ""),
    )
    if step < _TINY:
        power = math.floor(math.log10(largest))
        scale, suffix = 10.0**power, f"e\N{MINUS SIGN}{-power}"
    step /= scale
    digits = next(digits for digits in range(16) if math.isclose(round(step, digits), step, rel_tol=1e-6))
    return tuple(decimal(tick / scale, digits) + (suffix if tick else "") for tick in ticks)


def _nice_step(least: float) -> float:
    power: float = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1.0, 2.0, 2.5, 5.0, 10.0) if factor * power >= least * (1 - 1e-9))


@dataclass(frozen=True)
class _Place:
    """The mapping of values to positions in the drawing, whose units are 0.8 pixels on a phone."""

    x_axis: Axis
    y_axis: Axis
    width: float = 440.0
    height: float = 270.0
    left: float = 52.0
    right: float = 428.0
    top: float = 12.0
    bottom: float = 226.0

    @property
    def ticks_across(self) -> list[tuple[float, str]]:
        return [(self.across(value), text) for value, text in zip(self.x_axis.ticks, self.x_axis.shown, strict=True)]

    @property
    def ticks_up(self) -> list[tuple[float, str]]:
        return [(self.down(value), text) for value, text in zip(self.y_axis.ticks, self.y_axis.shown, strict=True)]

    def across(self, value: float) -> float:
        share = (value - self.x_axis.low) / (self.x_axis.high - self.x_axis.low)
        return round(self.left + share * (self.right - self.left), 2)

    def down(self, value: float) -> float:
        share = (value - self.y_axis.low) / (self.y_axis.high - self.y_axis.low)
        return round(self.bottom - min(max(share, 0.0), 1.0) * (self.bottom - self.top), 2)

    def horizontal(self, value: float, style: str) -> Line:
        """Return the ends of a reference line at a height."""
        return Line("", [self.left, self.right], [self.down(value)] * 2, style)

    def band(self, line: Line) -> list[tuple[float, float, float]]:
        """Return x, low and high of the points that have an interval."""
        if line.low is None or line.high is None:
            return []
        sides = zip(line.x, line.low, line.high, strict=True)
        return [
            (self.across(x), self.down(low), self.down(high))
            for x, low, high in sides
            if math.isfinite(low) and math.isfinite(high)
        ]

    def pieces(self, line: Line) -> list[list[tuple[float, float]]]:
        """Return the points of a curve, split at missing values."""
        points = zip(line.x, line.y, strict=True)
        pieces = [list(piece) for known, piece in groupby(points, lambda point: math.isfinite(point[1])) if known]
        return [[(self.across(x), self.down(y)) for x, y in piece] for piece in pieces if len(piece) > 1]

    def marks(self, line: Line) -> list[tuple[float, float, str]]:
        """Return the places of values, each with its name."""
        return [
            (self.across(x), self.down(y), f"{line.name}: {decimal(y, 3)} at {decimal(x, 2)}")
            for x, y in zip(line.x, line.y, strict=True)
            if math.isfinite(y)
        ]
