"""Report sections on the run: episodes from best to worst, training curves, stride calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

from markupsafe import Markup

from vjepa2_ac.evaluation.result import EpisodeScore, Evaluation, TrainingCurve
from vjepa2_ac.reports.html.charts import Line, axis_at, line_chart, nice_axis
from vjepa2_ac.reports.html.formatting import NOT_MEASURED, decimal, percent
from vjepa2_ac.reports.html.templates import render, visible

_AT_EACH_END = 8  # episodes in a table
_MOST_POINTS = 300  # of a curve
_FIRST = ("training loss", "validation: error / persistence", "learning rate", "grad norm")
_STYLES = ("s-trained", "s-base", "s-other0", "s-other1", "s-other2", "s-other3", "s-zero", "s-shuffled")


def episode_section(evaluation: Evaluation) -> Markup:
    """Return the section on the best and worst episodes."""
    scores = evaluation.episodes
    if not scores:
        return render("episodes", tables=())
    parts = {f"All {len(scores)} episodes, best first": scores}
    if len(scores) > 2 * _AT_EACH_END:
        parts = {
            f"The {_AT_EACH_END} best of {len(scores)} episodes, best first": scores[:_AT_EACH_END],
            f"The {_AT_EACH_END} worst of {len(scores)} episodes, worst last": scores[-_AT_EACH_END:],
        }
    tables = [(caption, *_episodes(part)) for caption, part in parts.items()]
    return render("episodes", evaluation=evaluation, tables=tables, chart=_episode_chart(scores))


def training_section(evaluation: Evaluation) -> Markup:
    """Return the section on training curves, those of one kind in one chart."""
    kinds: dict[str, list[TrainingCurve]] = {}
    for curve in evaluation.training:
        if any(map(math.isfinite, curve.values)):
            kinds.setdefault(_kind(curve.name), []).append(curve)
    charts = {kind: _training_chart(kind, curves) for kind, curves in kinds.items()}
    first = [kind for kind in _FIRST if kind in kinds]
    rest = [kind for kind in kinds if kind not in first]
    return render("training", charts=charts, first=first, rest=rest, most_points=_MOST_POINTS)


def calibration_section(evaluation: Evaluation) -> Markup:
    """Return the section on the error at each stride, if it was measured."""
    found = evaluation.calibration or {}
    head = ["stride (control steps)", "seconds per model step", "one-step L1 error / persistence", "clips", "episodes"]
    rows = [_stride(one) for one in found.get("strides", ())]
    return render("strides", evaluation=evaluation, head=head, rows=rows)


def _episode_chart(scores: Sequence[EpisodeScore]) -> Markup:
    """Return the error over persistence of every episode, best first."""
    places = [float(place + 1) for place in range(len(scores))]
    line = Line("episode", places, [score.over_persistence for score in scores], "s-trained")
    y_axis = nice_axis("L1 error / persistence", [*line.y, 1.0], from_zero=True)
    x_axis = axis_at("episodes, best first", places, [f"{place:.0f}" for place in places])
    better = sum(score.over_persistence < 1 for score in scores)
    description = f"Error over persistence of {len(scores)} episodes, best first: {better} of them are below 1."
    return line_chart(description, [line], x_axis, y_axis, level=1.0)


def _episodes(scores: Sequence[EpisodeScore]) -> tuple[list[str], list[list[str]]]:
    """Return the head and the rows of a table."""
    with_base = any(score.gain_over_base is not None for score in scores)
    rows = []
    for score in scores:
        cells = [_long_name(score.episode_id), str(score.clips), decimal(score.over_persistence)]
        if with_base:
            gain = score.gain_over_base
            cells.append(NOT_MEASURED if gain is None else percent(gain, 1, with_sign=True))
        rows.append(cells)
    return ["episode", "clips", "L1 error / persistence", *(["gain over the base"] if with_base else [])], rows


def _long_name(episode_id: str) -> Markup:
    """Return an id that may break after each slash."""
    return Markup("/<wbr>").join(map(visible, episode_id.split("/")))


def _kind(name: str) -> str:
    """Return the chart of a curve: that of losses, of validation, or one of its own."""
    where, _, what = name.rpartition("/")
    if where == "validation":
        return "validation: error / persistence" if "over_persistence" in what else f"validation: {_words(what)}"
    return "training loss" if what.startswith("loss") and what != "loss_scale" else _words(what)


def _words(name: str) -> str:
    return name.rpartition("/")[2].replace("_", " ")


def _training_chart(kind: str, curves: Sequence[TrainingCurve]) -> Markup:
    lines = [_training_line(curve, style) for curve, style in zip(curves, cycle(_STYLES), strict=False)]
    everything = [value for line in lines for value in line.y]
    x_axis = nice_axis("optimizer steps", [float(x) for line in lines for x in line.x], most=5)
    description = f"{kind} over optimizer steps: " + "; ".join(
        f"{curve.name} from {curve.values[0]:.4g} to {curve.values[-1]:.4g}" for curve in curves
    )
    return line_chart(description, lines, x_axis, nice_axis("", everything, most=5), key=lines)


def _training_line(curve: TrainingCurve, style: str) -> Line:
    every = -(-len(curve.steps) // _MOST_POINTS)
    kept = sorted({*range(0, len(curve.steps), every), len(curve.steps) - 1})
    return Line(_words(curve.name), [float(curve.steps[k]) for k in kept], [curve.values[k] for k in kept], style)


def _stride(one: Mapping[str, Any]) -> list[str]:
    error = one["error_over_persistence"]
    shown = decimal(error["value"])
    if error.get("low") is not None:
        shown += f" [{decimal(error['low'])}, {decimal(error['high'])}]"
    return [str(one["stride"]), decimal(one["seconds_per_step"], 2), shown, str(one["clips"]), str(one["episodes"])]
