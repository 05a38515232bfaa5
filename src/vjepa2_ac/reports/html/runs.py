"""Report section on the run: episodes from best to worst, training curves, stride calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from vjepa2_ac.evaluation.result import EpisodeScore, Evaluation, TrainingCurve
from vjepa2_ac.reports.html.charts import Line, legend, line_chart, nice_axis
from vjepa2_ac.reports.html.distributions import episode_chart
from vjepa2_ac.reports.html.formatting import NOT_MEASURED, decimal, percent, seconds
from vjepa2_ac.reports.html.layout import ReportSection, figure, folded, listed, not_measured, paragraph, table
from vjepa2_ac.reports.html.markup import Markup, element, joined

_AT_EACH_END = 8  # episodes in a table
_MOST_POINTS = 300  # of a curve
_FIRST = ("training loss", "validation: error / persistence", "learning rate", "grad norm")
_STYLES = ("s-trained", "s-base", "s-other0", "s-other1", "s-other2", "s-other3", "s-zero", "s-shuffled")


def episode_section(evaluation: Evaluation) -> ReportSection:
    """Return the section on the best and worst episodes."""
    scores = evaluation.episodes
    title = "Episodes, best and worst"
    if not scores:
        return ReportSection("episodes", title, not_measured("Episodes", "This result holds no metrics by episode."))
    how = (
        f"The L1 error of a rollout {seconds(evaluation.seconds_ahead)} ahead over that of persistence, by episode:"
        " whether a mean hides a few bad ones. Episodes with few clips are at both ends by chance alone: look at them"
        " before you explain them."
    )
    drawing = figure(f"Error of {evaluation.trained} on every episode", episode_chart(scores), how)
    if len(scores) <= 2 * _AT_EACH_END:
        return ReportSection(
            "episodes", title, joined(drawing, _episodes(f"All {len(scores)} episodes, best first", scores))
        )
    tables = [
        _episodes(f"The {_AT_EACH_END} best of {len(scores)} episodes, best first", scores[:_AT_EACH_END]),
        _episodes(f"The {_AT_EACH_END} worst of {len(scores)} episodes, worst last", scores[-_AT_EACH_END:]),
    ]
    return ReportSection("episodes", title, joined(drawing, *tables))


def training_section(evaluation: Evaluation) -> ReportSection:
    """Return the section on training curves, those of one kind in one chart."""
    curves = [curve for curve in evaluation.training if any(math.isfinite(value) for value in curve.values)]
    if not curves:
        why = "What was evaluated has no metrics.jsonl: it is a model, not a run, or the file is gone."
        return ReportSection("training", "Training", not_measured("Training curves", why))
    kinds: dict[str, list[TrainingCurve]] = {}
    for curve in curves:
        kinds.setdefault(_kind(curve.name), []).append(curve)
    first = [kind for kind in _FIRST if kind in kinds]
    rest = [kind for kind in kinds if kind not in first]
    how = paragraph(
        "From metrics.jsonl of the run, over optimizer steps. A loss of training that falls while a metric of"
        f" validation rises is overfitting. Of long curves every n-th point is drawn, {_MOST_POINTS} at most.",
        class_="how",
    )
    body = joined(how, _training_charts(kinds, first))
    if rest:
        body = joined(body, folded("Speed, memory and other metrics", _training_charts(kinds, rest)))
    return ReportSection("training", "Training", body)


def calibration_section(evaluation: Evaluation) -> ReportSection:
    """Return the section on the error at each stride, if it was measured."""
    found = evaluation.calibration
    title = "Length of a model step"
    if found is None:
        why = "Strides are measured by `vjepa2-ac data calibrate`; this evaluation was made without."
        return ReportSection("strides", title, not_measured("Other strides", why))
    rows = [_stride(one) for one in found.get("strides", ())]
    head = ["stride (control steps)", "seconds per model step", "one-step L1 error / persistence", "clips", "episodes"]
    body = table("One-step, teacher-forced error at each stride (value [95 % interval])", head, rows)
    unmeasured = [
        f"Stride {stride} could not be measured: {why}." for stride, why in found.get("impossible", {}).items()
    ]
    parts = [paragraph(str(found.get("verdict", ""))), body, listed(*unmeasured) if unmeasured else Markup()]
    return ReportSection("strides", title, joined(*parts))


def _episodes(caption: str, scores: Sequence[EpisodeScore]) -> Markup:
    with_base = any(score.gain_over_base is not None for score in scores)
    rows = []
    for score in scores:
        cells = [_long_name(score.episode_id), str(score.clips), decimal(score.over_persistence)]
        if with_base:
            gain = score.gain_over_base
            cells.append(NOT_MEASURED if gain is None else ("+" if gain > 0 else "") + percent(gain, 1))
        rows.append(cells)
    head = ["episode", "clips", "L1 error / persistence", *(["gain over the base"] if with_base else [])]
    return table(caption, head, rows, class_="names")


def _long_name(episode_id: str) -> Markup:
    """Return an id that may break after each slash."""
    return joined(*episode_id.split("/"), by=joined("/", element("wbr")))


def _kind(name: str) -> str:
    """Return the chart of a curve: that of losses, of validation, or one of its own."""
    where, _, what = name.rpartition("/")
    if where == "validation":
        return "validation: error / persistence" if "over_persistence" in what else f"validation: {_words(what)}"
    return "training loss" if what.startswith("loss") and what != "loss_scale" else _words(what)


def _words(name: str) -> str:
    return name.rpartition("/")[2].replace("_", " ")


def _training_charts(kinds: Mapping[str, Sequence[TrainingCurve]], names: Sequence[str]) -> Markup:
    charts = [element("div", _training_chart(name, kinds[name]), class_="small-chart") for name in names]
    return element("div", *charts, class_="small-charts")


def _training_chart(kind: str, curves: Sequence[TrainingCurve]) -> Markup:
    lines = [_training_line(curve, style) for curve, style in zip(curves, _cycled(len(curves)), strict=True)]
    everything = [value for line in lines for value in line.y]
    x_axis = nice_axis("optimizer steps", [float(x) for line in lines for x in line.x], most=5)
    description = f"{kind} over optimizer steps: " + "; ".join(
        f"{curve.name} from {curve.values[0]:.4g} to {curve.values[-1]:.4g}" for curve in curves
    )
    chart = line_chart(description, lines, x_axis, nice_axis("", everything, most=5))
    return element("figure", element("figcaption", element("h3", kind)), chart, legend(lines))


def _training_line(curve: TrainingCurve, style: str) -> Line:
    every = -(-len(curve.steps) // _MOST_POINTS)
    kept = sorted({*range(0, len(curve.steps), every), len(curve.steps) - 1})
    return Line(_words(curve.name), [float(curve.steps[k]) for k in kept], [curve.values[k] for k in kept], style)


def _cycled(count: int) -> list[str]:
    return [_STYLES[place % len(_STYLES)] for place in range(count)]


def _stride(one: Mapping[str, Any]) -> list[str]:
    error = one["error_over_persistence"]
    shown = decimal(error["value"])
    if error.get("low") is not None:
        shown += f" [{decimal(error['low'])}, {decimal(error['high'])}]"
    return [str(one["stride"]), decimal(one["seconds_per_step"], 2), shown, str(one["clips"]), str(one["episodes"])]
