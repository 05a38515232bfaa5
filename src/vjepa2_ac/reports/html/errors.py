"""Report section on errors: curves and tables by horizon and by stratum, compared between models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from vjepa2_ac.evaluation.estimates import (
    difference_to,
    gain_over,
    mean_error,
    over_persistence,
    stratum_gain,
    stratum_over_persistence,
)
from vjepa2_ac.evaluation.intervals import Estimate
from vjepa2_ac.evaluation.metrics import L1, Metric
from vjepa2_ac.evaluation.result import MODES, Evaluation, Mode, ModelResult, PredictionErrors, Stratum, Way
from vjepa2_ac.reports.html.charts import Axis, Line, axis_at, legend, line_chart, nice_axis
from vjepa2_ac.reports.html.formatting import seconds
from vjepa2_ac.reports.html.layout import (
    ReportSection,
    figure,
    folded,
    not_measured,
    paragraph,
    share,
    side_by_side,
    signed_value,
    table,
    value,
)
from vjepa2_ac.reports.html.markup import Markup, joined
from vjepa2_ac.reports.html.series import Series, models_of, persistence, wrong_actions_of

_MODES = {"rollout": "open-loop rollout", "teacher_forced": "teacher-forced"}
_MOTIONS = ("moving", "idle")
_HOW = {
    "rollout": (
        "The model sees the first frame and the actions, and feeds its own predictions back. The dashed line at 1 is"
        " persistence: copying the first frame. Lower is better; above 1, doing nothing would have been better. Bands:"
        " 95 % intervals over episodes; those of wrong actions are in the table."
    ),
    "teacher_forced": (
        "The model predicts each frame from all true frames before it: always one step ahead, later ones with more"
        " context. The dashed line at 1 is persistence: copying the frame before."
    ),
}

CurveOf = Callable[[PredictionErrors, Mode, Metric, Way], Sequence[Estimate]]  # of `evaluation.estimates`


def error_section(evaluation: Evaluation) -> ReportSection:
    """Return the section on the error by horizon of every model, as curves and as numbers."""
    drawings = []
    for mode in reversed(MODES):
        wrong, right = (
            [_line(evaluation, one, over_persistence(one.model.errors, mode, L1, one.way)) for one in shown]
            for shown in (wrong_actions_of(evaluation), models_of(evaluation))
        )
        lines = [*(replace(line, low=None, high=None) for line in wrong), *right]
        y_axis = nice_axis("L1 error / persistence", [*_reached(lines), 1.0], from_zero=True)
        description = f"Error over persistence by horizon, {_MODES[mode]}: {_as_text(lines)}."
        chart = line_chart(description, lines, _time_axis(evaluation), y_axis, level=1.0)
        key = legend([Line("persistence (doing nothing)", (), (), "s-persistence"), *reversed(lines)])
        drawings.append(figure(f"Error by horizon, {_MODES[mode]}", joined(chart, key), _HOW[mode]))
    tables = _tables(evaluation, L1, over_persistence, "over persistence")
    for metric in evaluation.metrics[1:]:
        ratios = _tables(evaluation, metric, over_persistence, "over persistence")
        tables.append(folded(f"Error over persistence, {metric.heading}: {metric.explanation}", *ratios))
    for metric in evaluation.metrics:
        means = _tables(evaluation, metric, mean_error, "")
        tables.append(folded(f"The errors themselves, {metric.heading}: {metric.explanation}", *means))
    return ReportSection("errors", "Error by horizon", joined(side_by_side(*drawings), *tables))


def base_section(evaluation: Evaluation) -> ReportSection:
    """Return the section that compares the trained and other models with the base: paired, clip by clip."""
    title = "Compared with the base"
    if evaluation.base is None:
        why = "There is no base model in this evaluation to compare with."
        return ReportSection("base", title, not_measured("Differences to the base", why))
    compared = [one for one in models_of(evaluation) if one.model.role != "base"]
    base = evaluation.models[evaluation.base]
    lines = [_line(evaluation, one, gain_over(one.model.errors, base.errors)) for one in compared]
    in_percent = [
        replace(line, y=[100 * y for y in line.y], low=_in_percent(line.low), high=_in_percent(line.high))
        for line in lines
    ]
    y_axis = nice_axis("gain over the base (%)", [*_reached(in_percent), 0.0])
    description = f"Gain over the base in percent by horizon, open-loop rollout: {_as_text(in_percent, 1)}."
    chart = joined(line_chart(description, in_percent, _time_axis(evaluation), y_axis, level=0.0), legend(in_percent))
    how = (
        "By which share of the base's error the model's is smaller. Both predict the same clips, so what makes a clip"
        " hard for both cancels out. Above 0 is better than the base; where the band includes 0, nothing is shown."
    )
    drawing = figure("Gain over the base by horizon, open-loop rollout", chart, how)
    tables = [_compared_table(evaluation, one.model, base) for one in compared]
    return ReportSection("base", title, joined(drawing, *tables))


def strata_section(evaluation: Evaluation) -> ReportSection:
    """Return the section on the one-step error of groups of steps."""
    title = "Where it helps: moving and idle, small and large actions"
    if not evaluation.strata:
        return ReportSection("strata", title, not_measured("Strata", "This result holds no strata."))
    how = paragraph(
        "One-step, teacher-forced L1 error over persistence. While nothing moves, copying the frame is hard to beat and"
        " a ratio above 1 matters little; where much moves, it matters most. ",
        f"A step counts as moving by this rule: {evaluation.clips.moving_means}.",
        class_="how",
    )
    motions = {stratum.name for stratum in evaluation.strata}
    kinds = list(dict.fromkeys(stratum.kind for stratum in evaluation.strata))
    tables = [_strata_table(evaluation, kind, [one for one in evaluation.strata if one.kind == kind]) for kind in kinds]
    without = [paragraph(f"None of the steps is {name}.") for name in _MOTIONS if name not in motions]
    return ReportSection("strata", title, joined(how, *tables, *(without if len(without) < len(_MOTIONS) else ())))


def horizon_name(evaluation: Evaluation, horizon: int) -> str:
    """Return a horizon in model steps and in seconds; 1 is the first."""
    return f"{horizon} ({seconds(horizon * evaluation.about.seconds_per_step)})"


def _tables(evaluation: Evaluation, metric: Metric, curve_of: CurveOf, over: str) -> list[Markup]:
    """Return a table of the rollout and a teacher-forced one; of the errors themselves also persistence has some."""
    shown = (*models_of(evaluation), *wrong_actions_of(evaluation))
    shown = shown if over else (persistence(evaluation), *shown)
    tables = []
    for mode in reversed(MODES):
        columns = [curve_of(one.model.errors, mode, metric, one.way) for one in shown]
        rows = [
            [horizon_name(evaluation, h + 1), *(value(column[h], 3 if over else 4) for column in columns)]
            for h in range(evaluation.horizon)
        ]
        name = f"{metric.heading} {'error' if metric.smaller_is_better else ''} {over}"
        caption = f"{' '.join(name.split())} by horizon, {_MODES[mode]} (no unit; value [95 % interval])"
        tables.append(table(caption, ["model steps ahead", *(one.label for one in shown)], rows))
    return tables


def _compared_table(evaluation: Evaluation, one: ModelResult, base: ModelResult) -> Markup:
    pair = one.errors, base.errors
    columns = [(gain_over(*pair, mode), difference_to(*pair, mode)) for mode in reversed(MODES)]
    rows = [
        [
            horizon_name(evaluation, h + 1),
            *(cell for gains, differences in columns
              for cell in (share(gains[h], with_sign=True), signed_value(differences[h]))),
        ]
        for h in range(evaluation.horizon)
    ]  # fmt: skip
    head = ["model steps ahead"] + [
        f"{what}, {_MODES[mode]}" for mode in reversed(MODES) for what in ("gain", "L1 difference")
    ]
    caption = f"{one.name} against {base.name}, paired by clip (value [95 % interval]; a gain above 0 is better)"
    return table(caption, head, rows)


def _strata_table(evaluation: Evaluation, kind: str, strata: Sequence[Stratum]) -> Markup:
    shown = models_of(evaluation)
    base = evaluation.base_errors
    what = kind if kind == "motion" or evaluation.about.space.position is not None else "norm of the action"
    rows = []
    for stratum in strata:
        cells = [value(stratum_over_persistence(one.model.errors, stratum)) for one in shown]
        if base is not None:
            cells.append(share(stratum_gain(evaluation.errors, base, stratum), with_sign=True))
        rows.append([stratum.name, str(int(stratum.steps.sum())), *cells])
    head = [what, "steps", *(one.label for one in shown)]
    head += [f"gain of {evaluation.trained} over {evaluation.base}"] if base is not None else []
    return table(f"One-step L1 error over persistence by {kind} (value [95 % interval])", head, rows)


def _line(evaluation: Evaluation, one: Series, curve: Sequence[Estimate]) -> Line:
    x = [(h + 1) * evaluation.about.seconds_per_step for h in range(len(curve))]
    low, high = [each.low for each in curve], [each.high for each in curve]
    has_band = any(each.has_interval for each in curve)
    return Line(
        one.label, x, [each.value for each in curve], one.style, low if has_band else None, high if has_band else None
    )


def _in_percent(side: Sequence[float] | None) -> Sequence[float] | None:
    return None if side is None else [100 * each for each in side]


def _reached(lines: Sequence[Line]) -> list[float]:
    return [each for line in lines for side in (line.y, line.low, line.high) if side is not None for each in side]


def _as_text(lines: Sequence[Line], digits: int = 2) -> str:
    """Return as text the first and last value of each curve."""
    return "; ".join(f"{line.name} from {line.y[0]:.{digits}f} to {line.y[-1]:.{digits}f}" for line in reversed(lines))


def _time_axis(evaluation: Evaluation) -> Axis:
    times = [(h + 1) * evaluation.about.seconds_per_step for h in range(evaluation.horizon)]
    return axis_at("seconds ahead", times, [f"{time:.2f}" for time in times])
