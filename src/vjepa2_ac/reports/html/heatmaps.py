"""Heatmaps of the energy over two axes of the action, with the true action and the minimum marked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from vjepa2_ac.reports.html.charts import nice_axis
from vjepa2_ac.reports.html.images import colours_of, png_url
from vjepa2_ac.reports.html.markup import Markup, element

_SIZE = 190.0  # of the map, in units of the drawing
_LEFT, _TOP, _RIGHT, _BOTTOM = 46.0, 8.0, 12.0, 42.0
_PIXELS = 96  # of the image along each side
_COLOURS = "viridis"


@dataclass(frozen=True, eq=False)
class MapAxis:
    """One axis of a map: its nodes, ascending, and the marked values."""

    label: str
    nodes: Float[np.ndarray, " nodes"]
    true: float
    minimum: float

    @property
    def edges(self) -> Float[np.ndarray, " edges"]:
        """The borders between the cells of the nodes: half way between them."""
        middle = (self.nodes[1:] + self.nodes[:-1]) / 2
        return np.concatenate([[2 * self.nodes[0] - middle[0]], middle, [2 * self.nodes[-1] - middle[-1]]])

    @property
    def cell_of_pixel(self) -> Int[np.ndarray, " pixels"]:
        """The node of each pixel of the image."""
        edges = self.edges
        centres = edges[0] + (np.arange(_PIXELS) + 0.5) / _PIXELS * (edges[-1] - edges[0])
        return np.asarray(np.clip(np.searchsorted(edges, centres) - 1, 0, len(self.nodes) - 1))

    def share(self, value: float) -> float:
        """Return the relative position of a value: 0 at the lower end, 1 at the upper."""
        return (value - float(self.edges[0])) / float(self.edges[-1] - self.edges[0])


def heat_map(
    description: str,
    energy: Float[np.ndarray, "across up"],
    across: MapAxis,
    up: MapAxis,
    limits: tuple[float, float],
) -> Markup:
    """Return a map as SVG; `limits` are the energies of the darkest and the brightest colour."""
    pixels = colours_of(energy[np.ix_(across.cell_of_pixel, up.cell_of_pixel)].T[::-1], *limits, _COLOURS)
    frame = {"x": _LEFT, "y": _TOP, "width": _SIZE, "height": _SIZE}
    return element(
        "svg",
        element("title", description),
        element("image", href=png_url(np.ascontiguousarray(pixels)), preserveAspectRatio="none", **frame),
        *_axis_across(across),
        *_axis_up(up),
        *_ring(_x(across, across.minimum), _y(up, up.minimum)),
        *_cross(_x(across, across.true), _y(up, up.true)),
        class_="map",
        viewBox=f"0 0 {_LEFT + _SIZE + _RIGHT:g} {_TOP + _SIZE + _BOTTOM:g}",
        role="img",
        aria_label=description,
    )


def _x(axis: MapAxis, value: float) -> float:
    return round(_LEFT + _SIZE * axis.share(value), 2)


def _y(axis: MapAxis, value: float) -> float:
    return round(_TOP + _SIZE * (1 - axis.share(value)), 2)


def _axis_across(axis: MapAxis) -> list[Markup]:
    bottom = _TOP + _SIZE
    parts = [element("text", axis.label, x=_LEFT + _SIZE / 2, y=bottom + 36, text_anchor="middle")]
    for value, shown in _ticks(axis):
        x = _x(axis, value)
        parts.append(element("line", x1=x, x2=x, y1=bottom, y2=bottom + 4, class_="axis"))
        parts.append(element("text", shown, x=x, y=bottom + 17, text_anchor="middle"))
    x = _x(axis, 0.0)
    return (
        [*parts, element("line", x1=x, x2=x, y1=_TOP, y2=bottom, class_="zero")] if 0 < axis.share(0.0) < 1 else parts
    )


def _axis_up(axis: MapAxis) -> list[Markup]:
    middle = _TOP + _SIZE / 2
    parts = [element("text", axis.label, transform=f"translate(12 {middle:g}) rotate(-90)", text_anchor="middle")]
    for value, shown in _ticks(axis):
        y = _y(axis, value)
        parts.append(element("line", x1=_LEFT - 4, x2=_LEFT, y1=y, y2=y, class_="axis"))
        parts.append(element("text", shown, x=_LEFT - 7, y=y + 4, text_anchor="end"))
    y = _y(axis, 0.0)
    line = element("line", x1=_LEFT, x2=_LEFT + _SIZE, y1=y, y2=y, class_="zero")
    return [*parts, line] if 0 < axis.share(0.0) < 1 else parts


def _ticks(axis: MapAxis) -> list[tuple[float, str]]:
    nice = nice_axis("", [float(axis.edges[0]), float(axis.edges[-1])], most=4)
    return [(value, shown) for value, shown in zip(nice.ticks, nice.shown, strict=True) if 0 <= axis.share(value) <= 1]


def _ring(x: float, y: float) -> list[Markup]:
    return [element("circle", cx=x, cy=y, r=9, class_=f"ring {side}") for side in ("under", "over")]


def _cross(x: float, y: float) -> list[Markup]:
    d = f"M{x - 6:g} {y:g}H{x + 6:g}M{x:g} {y - 6:g}V{y + 6:g}"
    return [element("path", d=d, class_=f"cross {side}") for side in ("under", "over")]
