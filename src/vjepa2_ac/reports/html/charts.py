"""Charts as SVG in the page's colours, light or dark: lines, bands, legend, axes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vjepa2_ac.reports.html.formatting import decimal
from vjepa2_ac.reports.html.markup import Markup, element, joined

_WIDTH, _HEIGHT = 440.0, 270.0  # in units of the drawing; on a phone one is 0.8 px
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 12.0, 12.0, 44.0
_RADIUS = 3.2
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
    description: str, lines: Sequence[Line], x_axis: Axis, y_axis: Axis, *, level: float | None = None
) -> Markup:
    """Return curves as SVG.

    Args:
        description: Description of the chart, as alternative text.
        lines: Later ones are drawn on top.
        x_axis: The horizontal axis.
        y_axis: The vertical axis; values outside are clipped.
        level: Height of a horizontal reference line.
    """
    place = _Place(x_axis, y_axis)
    drawn = [_band(line, place) for line in lines] + [_curve(line, place) for line in lines]
    reference = element(
        "line", class_="level", x1=_LEFT, x2=_WIDTH - _RIGHT, y1=place.down(level), y2=place.down(level)
    ) if level is not None else Markup()  # fmt: skip
    return element(
        "svg",
        element("title", description),
        _grid(place),
        reference,
        *drawn,
        class_="chart",
        viewBox=f"0 0 {_WIDTH:g} {_HEIGHT:g}",
        role="img",
        aria_label=description,
    )


def dot_chart(description: str, lines: Sequence[Line], x_axis: Axis, y_axis: Axis) -> Markup:
    """Return a scatter chart, with the diagonal of equal values, and zero lines.

    Args:
        description: Description of the chart, as alternative text.
        lines: The points; later ones are drawn on top.
        x_axis: The horizontal axis.
        y_axis: The vertical axis, zero included.
    """
    place = _Place(x_axis, y_axis)
    low, high = max(x_axis.low, y_axis.low), min(x_axis.high, y_axis.high)
    ends = {"x1": place.across(low), "x2": place.across(high), "y1": place.down(low), "y2": place.down(high)}
    zero = {"x1": _LEFT, "x2": _WIDTH - _RIGHT, "y1": place.down(0.0), "y2": place.down(0.0)}
    return element(
        "svg",
        element("title", description),
        _grid(place),
        element("line", class_="axis", **zero),
        element("line", class_="level", **ends),
        *(_mark(line, x, y, place) for line in lines for x, y in zip(line.x, line.y, strict=True)),
        class_="chart",
        viewBox=f"0 0 {_WIDTH:g} {_HEIGHT:g}",
        role="img",
        aria_label=description,
    )


def legend(lines: Sequence[Line]) -> Markup:
    """Return the legend: each name beside a sample of its line."""
    entries = [element("li", swatch(line.style), line.name) for line in lines]
    return element("ul", *entries, class_="legend")


def swatch(style: str) -> Markup:
    """Return a sample of a line, as it is drawn in the charts."""
    line = element("line", x1=1, x2=27, y1=6, y2=6, class_=f"curve {style}")
    mark = element("circle", cx=14, cy=6, r=_RADIUS, class_=f"mark {style}")
    return element("svg", line, mark, class_="swatch", viewBox="0 0 28 12", width=28, height=12, aria_hidden="true")


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
    """The mapping of values to positions in the drawing."""

    x_axis: Axis
    y_axis: Axis

    def across(self, value: float) -> float:
        share = (value - self.x_axis.low) / (self.x_axis.high - self.x_axis.low)
        return round(_LEFT + share * (_WIDTH - _LEFT - _RIGHT), 2)

    def down(self, value: float) -> float:
        share = (value - self.y_axis.low) / (self.y_axis.high - self.y_axis.low)
        return round(_HEIGHT - _BOTTOM - min(max(share, 0.0), 1.0) * (_HEIGHT - _TOP - _BOTTOM), 2)


def _grid(place: _Place) -> Markup:
    bottom, right = _HEIGHT - _BOTTOM, _WIDTH - _RIGHT
    parts = []
    for value, shown in zip(place.y_axis.ticks, place.y_axis.shown, strict=True):
        y = place.down(value)
        parts += [
            element("line", x1=_LEFT, x2=right, y1=y, y2=y, class_="grid"),
            element("text", shown, x=_LEFT - 6, y=y + 4, text_anchor="end"),
        ]
    for value, shown in zip(place.x_axis.ticks, place.x_axis.shown, strict=True):
        x = place.across(value)
        parts += [
            element("line", x1=x, x2=x, y1=bottom, y2=bottom + 4, class_="axis"),
            element("text", shown, x=x, y=bottom + 17, text_anchor="middle"),
        ]
    middle = (_TOP + bottom) / 2
    return joined(
        *parts,
        element("line", x1=_LEFT, x2=right, y1=bottom, y2=bottom, class_="axis"),
        element("text", place.x_axis.label, x=(_LEFT + right) / 2, y=_HEIGHT - 8, text_anchor="middle"),
        element("text", place.y_axis.label, transform=f"translate(13 {middle:g}) rotate(-90)", text_anchor="middle"),
    )


def _band(line: Line, place: _Place) -> Markup:
    if line.low is None or line.high is None:
        return Markup()
    sides = [
        (place.across(x), place.down(low), place.down(high))
        for x, low, high in zip(line.x, line.low, line.high, strict=True)
        if math.isfinite(low) and math.isfinite(high)
    ]
    if len(sides) < 2:
        return joined(*(element("line", class_=f"curve {line.style}", x1=x, x2=x, y1=a, y2=b) for x, a, b in sides))
    upper = [f"{x:g} {high:g}" for x, _, high in sides]
    lower = [f"{x:g} {low:g}" for x, low, _ in reversed(sides)]
    return element("path", class_=f"band {line.style}", d=f"M{' L'.join(upper + lower)}Z")


def _curve(line: Line, place: _Place) -> Markup:
    points = list(zip(line.x, line.y, strict=True))
    parts = [
        element("polyline", class_=f"curve {line.style}", points=" ".join(f"{a:g},{b:g}" for a, b in piece))
        for piece in _pieces(points, lambda x, y: (place.across(x), place.down(y)))
    ]
    if len(points) <= _MOST_MARKED:
        parts += [_mark(line, x, y, place) for x, y in points if math.isfinite(y)]
    return joined(*parts)


def _mark(line: Line, x: float, y: float, place: _Place) -> Markup:
    words = f"{line.name}: {decimal(y, 3)} at {decimal(x, 2)}"
    centre = {"cx": place.across(x), "cy": place.down(y)}
    return element("circle", element("title", words), class_=f"mark {line.style}", r=_RADIUS, **centre)


def _pieces(
    points: Sequence[tuple[float, float]], placed: Callable[[float, float], tuple[float, float]]
) -> list[list[tuple[float, float]]]:
    """Split a curve at missing values."""
    pieces: list[list[tuple[float, float]]] = [[]]
    for x, y in points:
        if math.isfinite(y):
            pieces[-1].append(placed(x, y))
        elif pieces[-1]:
            pieces.append([])
    return [piece for piece in pieces if len(piece) > 1]
