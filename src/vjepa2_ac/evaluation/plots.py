"""What does it look like? One picture: error by horizon, use of the actions, and where predictions are wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vjepa2_ac.evaluation.evaluate import Evaluation, Example
from vjepa2_ac.evaluation.metrics import Ratio, one_step_ratios, ratios_by_horizon
from vjepa2_ac.evaluation.report import verdict
from vjepa2_ac.storage import atomic_writer

_COLOURS = {"persistence": "#8a8a8a", "base": "#d1762a", "adapter": "#1f6fb4", "model": "#1f6fb4"}


def plot_evaluation(evaluation: Evaluation, path: Path) -> Path:
    """Write the picture of an evaluation as PNG; it appears whole or not at all."""
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        rows = 1 + len(evaluation.example.errors)
        columns = len(evaluation.example.frames)
        figure = Figure(figsize=(max(9.0, 1.25 * columns + 2), 3.6 + 1.2 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(_wrapped(verdict(evaluation)), fontsize=10, x=0.01, ha="left")
        halves: Any = figure.subfigures(2, 1, height_ratios=[3.0, 1.15 * rows])
        top, bottom = halves
        left, right = top.subplots(1, 2, width_ratios=[3, 2])
        _curves(left, evaluation)
        _use_of_actions(right, evaluation)
        _filmstrip(bottom, evaluation.example, evaluation.seconds_per_step)
        with atomic_writer(path) as file:
            figure.savefig(file, format="png", dpi=130)
    return path


def _curves(axes: Any, evaluation: Evaluation) -> None:
    axes.axhline(1.0, color=_COLOURS["persistence"], linestyle="--", label="persistence (doing nothing)")
    for name, errors in evaluation.models.items():
        ratios = ratios_by_horizon(errors)
        seconds = evaluation.seconds_per_step * np.arange(1, len(ratios) + 1)
        axes.plot(seconds, [r.value for r in ratios], "o-", color=_COLOURS[name], label=name)
        axes.fill_between(
            seconds, [r.low for r in ratios], [r.high for r in ratios], color=_COLOURS[name], alpha=0.2, linewidth=0
        )
    axes.set(xlabel="seconds ahead (open loop)", ylabel="latent error / persistence", ylim=(0, None))
    axes.legend(frameon=False, loc="lower right")
    axes.set_title("Prediction error by horizon (band: 95 % over episodes)", loc="left", fontsize=9)


def _use_of_actions(axes: Any, evaluation: Evaluation) -> None:
    width = 0.8 / len(evaluation.models)
    for i, (name, errors) in enumerate(evaluation.models.items()):
        ratios = one_step_ratios(errors)
        places = np.arange(len(ratios)) + (i - (len(evaluation.models) - 1) / 2) * width
        values = [r.value for r in ratios.values()]
        spread = np.array([_reach(r) for r in ratios.values()]).T
        axes.bar(places, values, width, color=_COLOURS[name], yerr=spread, error_kw={"elinewidth": 1}, label=name)
    axes.axhline(1.0, color=_COLOURS["persistence"], linestyle="--")
    axes.set_xticks(range(3), ["true", "zero", "shuffled"])
    axes.set(xlabel="actions given", ylabel="one-step error / persistence")
    axes.set_title("Does it use the actions?", loc="left", fontsize=9)


def _reach(value: Ratio) -> tuple[float, float]:
    """How far an error bar reaches down and up; never negative, which rounding could make it."""
    if not value.has_interval:
        return 0.0, 0.0
    return max(0.0, value.value - value.low), max(0.0, value.high - value.value)


def _filmstrip(figure: Any, example: Example, seconds_per_step: float) -> None:
    columns = len(example.frames)
    grid = figure.subplots(1 + len(example.errors), columns, squeeze=False)
    largest = max(float(errors.max()) for errors in example.errors.values())
    size = example.frames.shape[1]
    for column in range(columns):
        grid[0][column].imshow(example.frames[column])
        grid[0][column].set_title("now" if column == 0 else f"+{column * seconds_per_step:.1f} s", fontsize=8)
        for row, (name, errors) in enumerate(example.errors.items(), start=1):
            axes = grid[row][column]
            if column == 0:
                axes.text(0.95, 0.5, f"{name}\nerror", ha="right", va="center", transform=axes.transAxes, fontsize=9)
                axes.set_axis_off()
                continue
            grey = example.frames[column].mean(axis=-1)
            axes.imshow(grey, cmap="gray", vmin=-100, vmax=255)
            axes.imshow(errors[column - 1], cmap="inferno", vmin=0, vmax=largest, alpha=0.65, extent=(0, size, size, 0))
            axes.set_xlim(0, size)
            axes.set_ylim(size, 0)
    for axes in grid.ravel():
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set_visible(False)


def _wrapped(text: str, width: int = 110) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, width))
