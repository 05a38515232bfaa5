"""The figure of calibrated axes: executed moves beside those that a model infers, from above."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vjepa2_ac.calibration.axes import AxisFit
from vjepa2_ac.reports.figures.page import headline, written_figure

_EXECUTED, _INFERRED, _FITTED = "#8a8a8a", "#1f6fb4", "#d1762a"


def plot_axes(fit: AxisFit, path: Path) -> Path:
    """Write moves in the horizontal plane, and the robot's x and y as the model takes them, as PNG, atomically."""
    with written_figure(path, 9.0, 4.6, dpi=110, size=9) as figure:
        found = {
            "yaw": fit.yaw_degrees,
            "fitted yaw": fit.fitted_yaw_degrees,
            "gain": fit.gain,
            "condition": fit.condition,
        }
        headline(figure, ", ".join(f"{name} {number}" for name, number in found.items()), across=110)
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        reach = 105 * max(float(np.abs(moves[:, :2]).max()) for moves in (fit.executed, fit.inferred)) or 1.0
        left.scatter(*(100 * fit.executed[:, :2].T), s=9, color=_EXECUTED, label="executed")
        left.scatter(*(100 * fit.inferred[:, :2].T), s=9, color=_INFERRED, label="inferred by the model")
        for axis, name in enumerate("xy"):
            for moved, colour in ((np.eye(3)[:2, axis], _EXECUTED), (fit.matrix[:2, axis], _FITTED)):
                along = 0.8 * reach * moved
                right.annotate("", along, (0, 0), arrowprops={"arrowstyle": "->", "color": colour, "lw": 2})
                right.annotate(name, along, color=colour)
        right.set_title("the robot's axes (grey), and what the model takes them for", fontsize=9)
        left.legend(frameon=False, fontsize=8, loc="upper left")
        for axes in (left, right):
            axes.set(xlabel="dx (cm)", ylabel="dy (cm)", xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    return path
