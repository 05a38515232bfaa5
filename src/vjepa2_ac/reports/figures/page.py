"""Page layout of a figure: positions in inches from the top left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Page:
    """A matplotlib figure with a size in inches."""

    figure: Any
    width: float
    height: float

    def axes(self, left: float, top: float, width: float, height: float) -> Any:
        """Return axes at this position."""
        return self.figure.add_axes(
            (left / self.width, 1 - (top + height) / self.height, width / self.width, height / self.height)
        )

    def text(self, left: float, top: float, words: str, **style: Any) -> None:
        """Write text with its top left corner at this position."""
        style = {"va": "top", "ha": "left", **style}
        self.figure.text(left / self.width, 1 - top / self.height, words, **style)


def new_figure(width: float, height: float, **options: Any) -> Figure:
    """Return a figure of so many inches with a canvas of its own: pyplot keeps figures, and may open windows."""
    figure = Figure(figsize=(width, height), **options)
    FigureCanvasAgg(figure)
    return figure
