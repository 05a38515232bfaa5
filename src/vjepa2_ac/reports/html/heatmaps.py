"""Heatmaps of the energy over two axes of the action, with the true action and the minimum marked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup

from vjepa2_ac.reports.html.charts import nice_axis
from vjepa2_ac.reports.html.images import colours_of, png_url
from vjepa2_ac.reports.html.templates import render

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

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """The positions of round values, and their text."""
        nice = nice_axis("", [float(self.edges[0]), float(self.edges[-1])], most=4)
        shares = [(self.share(value), text) for value, text in zip(nice.ticks, nice.shown, strict=True)]
        return [(share, text) for share, text in shares if 0 <= share <= 1]


def heat_map(
    description: str,
    energy: Float[np.ndarray, "across up"],
    across: MapAxis,
    up: MapAxis,
    limits: tuple[float, float],
) -> Markup:
    """Return a map as SVG; `limits` are the energies of the darkest and the brightest colour."""
    pixels = colours_of(energy[np.ix_(across.cell_of_pixel, up.cell_of_pixel)].T[::-1], *limits, _COLOURS)
    image = png_url(np.ascontiguousarray(pixels))
    return render("heat_map", description=description, image=image, across=across, up=up)
