"""The figure of an evaluation: error by horizon, action use, and maps of the prediction error."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.evaluation.estimates import Curve, one_step_over_persistence, over_persistence
from vjepa2_ac.evaluation.result import ACTIONS, Evaluation, Example
from vjepa2_ac.evaluation.verdict import verdict
from vjepa2_ac.reports.comparison import Comparison
from vjepa2_ac.reports.figures.page import BLUE, GREEN, GREY, ORANGE, RED, written_page

_NOTHING = "persistence (doing nothing)"
_COLOURS = {"base": ORANGE, "adapter": BLUE, "model": BLUE}
_RUNS = (BLUE, ORANGE, GREEN, "#8f5bb0", RED, "#0b7f8a", "#8a6d0b", "#333333")
_DASHES = ("-", "--", ":")  # after all colours
_STYLE = {"font.size": 9}
_OTHERS = ("#3a9155", "#8f5bb0", "#b0873a", "#4aa3a8")
_SHAPE = 1.3  # width over height of what there is for the filmstrip


def plot_evaluation(evaluation: Evaluation, path: Path) -> Path:
    """Write the figure of an evaluation as PNG; it is written atomically."""
    with written_page(path, 13.0, 6.2, dpi=110, style=_STYLE, layout="constrained") as page:
        page.headline(verdict(evaluation))
        halves = page.figure.subfigures(1, 2, width_ratios=[5, 6], wspace=0.02)
        upper, lower = halves[0].subplots(2, 1, height_ratios=[3, 2])
        _error_by_horizon(upper, evaluation)
        _use_of_actions(lower, evaluation)
        if evaluation.examples:
            _filmstrip(halves[1], evaluation.examples[0], evaluation.about.seconds_per_step)
    return path


def plot_comparison(comparison: Comparison, path: Path) -> Path:
    """Write the curves of several runs as PNG; it is written atomically."""
    styles = itertools.cycle({"linestyle": dashes, "color": colour} for dashes in _DASHES for colour in _RUNS)
    with written_page(path, 9.5, 4.5, dpi=110, style=_STYLE, layout="constrained") as page:
        axes = page.figure.subplots()
        drawn = _curves(axes, comparison.seconds, zip(comparison.curves.values(), styles, strict=False))
        axes.set(title=f"{comparison.title} (band: 95 % over episodes)")
        names = [_NOTHING, *(textwrap.fill(name, 34) for name in comparison.curves)]
        page.figure.legend(drawn, names, loc="outside right upper")
    return path


def _curves(axes: Any, seconds: np.ndarray, curves: Iterable[tuple[Curve, dict[str, str]]]) -> list[Any]:
    """Draw persistence and errors over it with their intervals, each in its style; return the lines."""
    drawn = [axes.axhline(1.0, color=GREY, linestyle="--")]
    for curve, style in curves:
        low, high = [one.low for one in curve], [one.high for one in curve]
        axes.fill_between(seconds, low, high, color=style["color"], alpha=0.15, linewidth=0)
        drawn += axes.plot(seconds, [one.value for one in curve], marker="o", **style)
    axes.set(xlabel="seconds ahead (open loop)", ylabel="latent error / persistence", ylim=(0, None))
    return drawn


def _error_by_horizon(axes: Any, evaluation: Evaluation) -> None:
    seconds = evaluation.about.seconds_per_step * np.arange(1, evaluation.horizon + 1)
    colours = _colours(evaluation)
    drawn = _curves(
        axes,
        seconds,
        ((over_persistence(evaluation.models[name].errors, "rollout"), {"color": colours[name]}) for name in colours),
    )
    shown = seconds[:: -(-len(seconds) // 8)]
    axes.set_xticks(shown, [f"{value:.2f}" for value in shown])
    axes.set(title="Prediction error by horizon (band: 95 % over episodes)")
    axes.legend(drawn, [_NOTHING, *colours], loc="lower right")


def _use_of_actions(axes: Any, evaluation: Evaluation) -> None:
    width = 0.8 / len(evaluation.models)
    for i, (name, colour) in enumerate(_colours(evaluation).items()):
        ratios = [one_step_over_persistence(evaluation.models[name].errors, actions) for actions in ACTIONS]
        places = np.arange(len(ratios)) + (i - (len(evaluation.models) - 1) / 2) * width
        spread = np.array([(r.value - r.low, r.high - r.value) for r in ratios]).T
        spread = np.nan_to_num(spread.clip(min=0))  # rounding could make it negative; NaN: there is no interval
        axes.bar(places, [r.value for r in ratios], width, color=colour, yerr=spread, error_kw={"elinewidth": 1})
    axes.axhline(1.0, color=GREY, linestyle="--")
    axes.set_xticks(range(len(ACTIONS)), ACTIONS)
    axes.set(title="Does it use the actions?", xlabel="actions given", ylabel="one-step error / persistence")


def _colours(evaluation: Evaluation) -> dict[str, str]:
    """Return a colour for each model."""
    others = iter(_OTHERS * len(evaluation.models))
    return {name: _COLOURS.get(name) or next(others) for name in evaluation.models}


def _filmstrip(figure: Any, example: Example, seconds_per_step: float) -> None:
    """Draw one clip: the first frame and some later ones, and below each the error map of a prediction.

    All tiles, each of size 1, lie in one pair of axes: drawing so many axes would take longer than all else.
    """
    horizons = np.unique(np.linspace(1, len(example.true_colours) - 1, num=4).round().astype(int))
    columns, rows = 1 + len(horizons), 1 + len(example.errors)
    right, down = max(1.06, 1.1 * _SHAPE * rows / columns), max(1.1, 1.06 * columns / rows / _SHAPE)  # to the next tile
    frames = example.true_colours if example.frames is None else example.frames
    largest = max(float(errors.max()) for errors in example.errors.values())
    figure.suptitle("One held-out clip, and the error of each patch (brighter is worse)", x=0.02, ha="left", fontsize=9)
    axes = figure.subplots()
    for column, time in enumerate([0, *horizons]):
        axes.imshow(frames[time], extent=_tile(right * column, 0.0))
        title = "now" if time == 0 else f"+{time * seconds_per_step:.2f} s"
        axes.text(right * column + 0.5, -0.08, title, ha="center", fontsize=8)
    for row, (name, errors) in enumerate(example.errors.items(), start=1):
        axes.text(0.5, down * row + 0.5, f"{name}\nerror", ha="center", va="center")
        for column, time in enumerate(horizons, start=1):
            _overlay(axes, _tile(right * column, down * row), frames[time], errors[time - 1], largest)
    axes.set_axis_off()
    side = (right - 1) / 2
    axes.set(xlim=(-side, right * columns - side), ylim=(down * (rows - 1) + 1, -0.3))


def _tile(left: float, top: float) -> tuple[float, float, float, float]:
    """Return where a tile lies: left, right, bottom, top."""
    return left, left + 1, top + 1, top


def _overlay(
    axes: Any, place: tuple[float, ...], frame: UInt8[np.ndarray, "size size 3"], errors: Any, largest: float
) -> None:
    axes.imshow(frame.mean(axis=-1), cmap="gray", vmin=-100, vmax=255, extent=place)
    axes.imshow(errors, cmap="inferno", vmin=0, vmax=largest, alpha=0.65, extent=place)
