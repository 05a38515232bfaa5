"""Report sections on errors: curves and tables by horizon and by stratum, compared between models."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from markupsafe import Markup

from vjepa2_ac.evaluation.distribution.mmd import Discrepancy
from vjepa2_ac.evaluation.estimates import (
    difference_to,
    gain_over,
    mean_error,
    over_persistence,
    stratum_gain,
    stratum_over_persistence,
)
from vjepa2_ac.evaluation.metrics import L1, Metric
from vjepa2_ac.evaluation.result import MODES, Evaluation, Mode, ModelResult, PredictionErrors, Stratum, Way
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.reports.html.charts import Axis, Line, axis_at, line_chart, nice_axis
from vjepa2_ac.reports.html.formatting import decimal, seconds, share, signed_value, value
from vjepa2_ac.reports.html.series import Series, models_of, persistence, wrong_actions_of
from vjepa2_ac.reports.html.templates import render

_MODES = {"rollout": "open-loop rollout", "teacher_forced": "teacher-forced"}
_MOTIONS = ("moving", "idle")

CurveOf = Callable[[PredictionErrors, Mode, Metric, Way], Sequence[Estimate]]  # of `evaluation.estimates`
Table = tuple[str, list[str], list[list[str]]]  # caption, head, rows


def error_section(evaluation: Evaluation) -> Markup:
    """Return the section on the error by horizon of every model, as curves and as numbers."""
    ratios = [("", _tables(evaluation, L1, over_persistence, "over persistence"))]
    for metric in evaluation.metrics[1:]:
        summary = f"Error over persistence, {metric.heading}: {metric.explanation}"
        ratios.append((summary, _tables(evaluation, metric, over_persistence, "over persistence")))
    means = [
        (f"The errors themselves, {one.heading}: {one.explanation}", _tables(evaluation, one, mean_error, ""))
        for one in evaluation.metrics
    ]
    return render("errors", ratios=ratios, means=means, **{mode: _error_by_horizon(evaluation, mode) for mode in MODES})


def base_section(evaluation: Evaluation) -> Markup:
    """Return the section that compares the trained and other models with the base: paired, clip by clip."""
    if evaluation.base is None:
        return render("base", chart=None)
    compared = [one for one in models_of(evaluation) if one.model.role != "base"]
    base = evaluation.models[evaluation.base]
    lines = [_line(evaluation, one, _in_percent(gain_over(one.model.errors, base.errors))) for one in compared]
    y_axis = nice_axis("gain over the base (%)", [*_reached(lines), 0.0])
    description = f"Gain over the base in percent by horizon, open-loop rollout: {_as_text(lines, 1)}."
    chart = line_chart(description, lines, _time_axis(evaluation), y_axis, level=0.0, key=lines)
    tables = [_compared_table(evaluation, one.model, base) for one in compared]
    return render("base", evaluation=evaluation, chart=chart, tables=tables)


def spread_section(evaluation: Evaluation) -> Markup:
    """Return the section on whether predictions are as varied as the truth, and distributed alike."""
    found = [(one, one.model.distribution) for one in models_of(evaluation)]
    if evaluation.persistence_distribution is not None:
        found.insert(0, (persistence(evaluation), evaluation.persistence_distribution.copies))
    measured = [(one, which) for one, which in found if which is not None]
    if not any(math.isfinite(each.value) for _, which in measured for each in which.spread):
        return render("spread", chart=None)
    lines = [_line(evaluation, one, which.spread) for one, which in measured]
    y_axis = nice_axis("spread / that of the truth", [*_reached(lines), 1.0], from_zero=True)
    description = f"Spread over that of the truth by horizon: {_as_text(lines)}."
    chart = line_chart(description, lines, _time_axis(evaluation), y_axis, level=1.0, key=lines)
    names = [horizon_name(evaluation, h + 1) for h in range(evaluation.horizon)]
    head = ["model steps ahead", *(one.label for one, _ in measured)]
    spreads = [[name, *(value(which.spread[h]) for _, which in measured)] for h, name in enumerate(names)]
    mmds = [[name, *(_discrepancy(which.mmd[h]) for _, which in measured)] for h, name in enumerate(names)]
    floors = evaluation.persistence_distribution.noise_floor if evaluation.persistence_distribution else ()
    if floors:
        head_of_mmds = [*head, "two halves of the truth stay below"]
        mmds = [[*row, decimal(floor)] for row, floor in zip(mmds, floors, strict=True)]
    else:
        head_of_mmds = head
    return render("spread", chart=chart, spread_head=head, spread_rows=spreads, mmd_head=head_of_mmds, mmd_rows=mmds)


def strata_section(evaluation: Evaluation) -> Markup:
    """Return the section on the one-step error of groups of steps."""
    kinds = dict.fromkeys(stratum.kind for stratum in evaluation.strata)
    tables = [_strata_table(evaluation, kind, [one for one in evaluation.strata if one.kind == kind]) for kind in kinds]
    missing = [name for name in _MOTIONS if name not in {stratum.name for stratum in evaluation.strata}]
    return render(
        "strata", evaluation=evaluation, tables=tables, missing=missing if len(missing) < len(_MOTIONS) else ()
    )


def horizon_name(evaluation: Evaluation, horizon: int) -> str:
    """Return a horizon in model steps and in seconds; 1 is the first."""
    return f"{horizon} ({seconds(horizon * evaluation.about.seconds_per_step)})"


def _error_by_horizon(evaluation: Evaluation, mode: Mode) -> Markup:
    wrong, right = (
        [_line(evaluation, one, over_persistence(one.model.errors, mode, L1, one.way)) for one in shown]
        for shown in (wrong_actions_of(evaluation), models_of(evaluation))
    )
    lines = [*(replace(line, low=None, high=None) for line in wrong), *right]
    y_axis = nice_axis("L1 error / persistence", [*_reached(lines), 1.0], from_zero=True)
    description = f"Error over persistence by horizon, {_MODES[mode]}: {_as_text(lines)}."
    key = [Line("persistence (doing nothing)", (), (), "s-persistence"), *reversed(lines)]
    return line_chart(description, lines, _time_axis(evaluation), y_axis, level=1.0, key=key)


def _tables(evaluation: Evaluation, metric: Metric, curve_of: CurveOf, over: str) -> list[Table]:
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
        caption = f"{' '.join(name.split())} by horizon, {_MODES[mode]}"
        tables.append((caption, ["model steps ahead", *(one.label for one in shown)], rows))
    return tables


def _discrepancy(found: Discrepancy) -> Markup:
    p_value = f"; p {decimal(found.p_value)}" if math.isfinite(found.p_value) else ""
    return value(found.squared) + p_value


def _compared_table(evaluation: Evaluation, one: ModelResult, base: ModelResult) -> Table:
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
    return one.name, head, rows


def _strata_table(evaluation: Evaluation, kind: str, strata: Sequence[Stratum]) -> Table:
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
    return kind, head, rows


def _line(evaluation: Evaluation, one: Series, curve: Sequence[Estimate]) -> Line:
    x = [(h + 1) * evaluation.about.seconds_per_step for h in range(len(curve))]
    low, high = [each.low for each in curve], [each.high for each in curve]
    has_band = any(each.has_interval for each in curve)
    return Line(
        one.label, x, [each.value for each in curve], one.style, low if has_band else None, high if has_band else None
    )


def _in_percent(curve: Sequence[Estimate]) -> list[Estimate]:
    return [Estimate(100 * each.value, 100 * each.low, 100 * each.high) for each in curve]


def _reached(lines: Sequence[Line]) -> list[float]:
    return [each for line in lines for side in (line.y, line.low, line.high) if side is not None for each in side]


def _as_text(lines: Sequence[Line], digits: int = 2) -> str:
    """Return as text the first and last value of each curve."""
    return "; ".join(f"{line.name} from {line.y[0]:.{digits}f} to {line.y[-1]:.{digits}f}" for line in reversed(lines))


def _time_axis(evaluation: Evaluation) -> Axis:
    times = [(h + 1) * evaluation.about.seconds_per_step for h in range(evaluation.horizon)]
    return axis_at("seconds ahead", times, [f"{time:.2f}" for time in times])
