"""Console output of an evaluation: tables of its metrics."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

from rich.table import Table

from vjepa2_ac.console.progress import MetricsTable
from vjepa2_ac.evaluation.action_score.metrics import AXES, PlanMetrics, metrics_of, signed_along, ways_of
from vjepa2_ac.evaluation.action_score.protocol import BEST_SCORE, STEPS
from vjepa2_ac.evaluation.axis_fit import AxisFit
from vjepa2_ac.evaluation.estimates import one_step_over_persistence, over_persistence, stratum_over_persistence
from vjepa2_ac.evaluation.intervals import Estimate
from vjepa2_ac.evaluation.result import ACTIONS, Evaluation, Landscapes, PlanningStudy, Sensitivity
from vjepa2_ac.reports.comparison import Comparison

_MOST_HORIZONS = 8  # rows; of longer clips some are left out, but are in metrics.json
_TOP = 5


def evaluation_tables(evaluation: Evaluation) -> tuple[Table, ...]:
    """Return the tables of `evaluate`: errors over persistence, then the use of the actions."""
    probed = any(model.sensitivity or model.landscapes for model in evaluation.models.values())
    study = evaluation.planning
    return (
        _errors(evaluation),
        *((_use_of_actions(evaluation),) if probed else ()),
        *((_plans(evaluation, study),) if study is not None else ()),
    )


def comparison_table(comparison: Comparison) -> Table:
    """Return the table of `compare`, a row per run."""
    table = MetricsTable(comparison.title)
    table.add_column("run")
    for column in comparison.columns:
        table.add_column(column, justify="right")
    for name, cells in comparison.rows.items():
        shown = zip(comparison.columns, cells, strict=True)
        table.add_row(name, *(_share(cell) if title.startswith("gain") else str(cell) for title, cell in shown))
    return table


def _share(cell: Estimate | str) -> str:
    """Return a gain in percent."""
    if isinstance(cell, str) or not cell.has_interval:
        return cell if isinstance(cell, str) else f"{cell.value:.1%}"
    return f"{cell.value:.1%} [{cell.low:.1%}, {cell.high:.1%}]"


def _errors(evaluation: Evaluation) -> Table:
    sure = "95 % interval over episodes" if evaluation.clips.episodes > 1 else "one episode: no interval"
    table = _table(f"Latent error / persistence on held-out episodes ({sure})", "open loop, L1")
    table.add_column("persistence", justify="right")
    for name in evaluation.models:
        table.add_column(name, justify="right")
    seconds, last = evaluation.about.seconds_per_step, evaluation.horizon
    models = [model.errors for model in evaluation.models.values()]
    curves = [over_persistence(errors, "rollout") for errors in models]
    for h in range(1, last + 1):
        if h == last or h % -(-last // _MOST_HORIZONS) == 0 or h == 1:
            _row(table, f"{h * seconds:.2f} s ahead", [curve[h - 1] for curve in curves])
    for metric in evaluation.metrics[1:]:
        ratios = [over_persistence(errors, "rollout", metric)[-1] for errors in models]
        _row(table, f"{last * seconds:.2f} s, {metric.heading}", ratios)
    table.add_section()
    for actions in ACTIONS:
        _row(table, f"one step, {actions} actions", [one_step_over_persistence(errors, actions) for errors in models])
    table.add_section()
    for part in evaluation.strata:
        _row(table, f"one step, {part.name}", [stratum_over_persistence(errors, part) for errors in models])
    return table


def _use_of_actions(evaluation: Evaluation) -> Table:
    table = _table("Use of the actions: one step from one frame", "")
    table.add_column("ignoring them", justify="right")
    for name in evaluation.models:
        table.add_column(name, justify="right")
    sensitivities = [model.sensitivity for model in evaluation.models.values()]
    if all(sensitivities):
        _sensitivity_rows(table, [one for one in sensitivities if one is not None])
    axes = [model.axes for model in evaluation.models.values()]
    if all(axes):
        table.add_section()
        _axes_rows(table, [one for one in axes if one is not None])
    landscapes = [model.landscapes for model in evaluation.models.values()]
    if all(landscapes):
        table.add_section()
        _landscape_rows(table, [one for one in landscapes if one is not None])
    return table


def _sensitivity_rows(table: Table, models: list[Sensitivity]) -> None:
    table.add_row("change with the action / persistence", "0.000", *(str(one.change) for one in models))
    for number, ranking in enumerate(models[0].rankings):
        where = "others' actions" if ranking.drawn_from == "clips" else "actions in a box"
        ranks = [str(one.rankings[number].mean_rank) for one in models]
        table.add_row(f"share of {where} that fit better", "0.500", *ranks)
        if _TOP in ranking.top:
            shares = [str(one.rankings[number].top[_TOP]) for one in models]
            label = f"true action in the best {_TOP} of {ranking.samples + 1}"
            table.add_row(label, f"{ranking.chance_of_top(_TOP):.3f}", *shares)


def _axes_rows(table: Table, models: list[AxisFit]) -> None:
    label = f"axes: yaw, degrees ({_clips(models[0].pairs)})"
    table.add_row(label, "", *(_short(one.yaw_degrees, 0, interval=True) for one in models))
    table.add_row("  error at it / unturned", "1.000", *(str(one.error) for one in models))
    table.add_row("  fitted yaw", "", *(_short(one.fitted_yaw_degrees, 0, interval=True) for one in models))
    table.add_row("  gain", "0.000", *(str(one.gain) for one in models))
    table.add_row("  condition", "", *(_short(one.condition, 1, interval=True) for one in models))


def _landscape_rows(table: Table, models: list[Landscapes]) -> None:
    first = models[0]
    unit = f"{first.unit}, " if first.unit else ""
    title = f"lowest energy to true action ({unit}{_clips(len(first.maps))})"
    table.add_row(title, f"{first.chance_distance:.3f}", *(str(one.distance) for one in models))
    for axis, name in enumerate(first.axis_names):
        if first.sign_clips[axis]:
            label = f"its {name} has the true sign ({_clips(first.sign_clips[axis])})"
            signs = [str(one.sign_agreement[axis]) for one in models]
            table.add_row(label, f"{first.sign_chance[axis]:.3f}", *signs)


def _plans(evaluation: Evaluation, study: PlanningStudy) -> Table:
    table = _table(f"Plans beside demonstrations, from {_clips(len(study))} (95 % interval over episodes)", "")
    found = {"doing nothing": study.zero, "random": study.random, "within limits": study.within_limits}
    ways = {**found, **ways_of(evaluation)}
    for name in ways:
        table.add_column(name, justify="right")
    metrics = [metrics_of(study, plans) for plans in ways.values()]

    def row(label: str, of: Callable[[PlanMetrics], Estimate], digits: int = 1) -> None:
        cells = [_short(of(one), digits, interval=name not in found) for name, one in zip(ways, metrics, strict=True)]
        table.add_row(label, *cells)

    row(f"Action Score (best {BEST_SCORE:.0f})", lambda one: one.score)
    row(f"end of {STEPS} steps off by, cm", lambda one: one.missed_cm)
    table.add_section()
    row("one step off by, cm", lambda one: one.step_cm)
    for axis, name in enumerate(AXES):
        row(f"  along {name}", partial(_on, "axes_cm", axis))
    row("  angle, degrees", lambda one: one.angle_degrees, 0)
    for axis, name in enumerate(AXES):
        count = int(signed_along(study, axis).sum())
        if count:
            row(f"  right sign of {name} ({_clips(count)})", partial(_on, "signs", axis), 2)
    row("  gripper off by", lambda one: one.gripper, 2)
    table.add_section()
    seconds = [plans.seconds / len(study) if plans.seconds else None for plans in ways.values()]
    table.add_row("seconds a clip", *("" if one is None else f"{one:.1f}" for one in seconds))
    return table


def _on(name: Literal["axes_cm", "signs"], axis: int, metrics: PlanMetrics) -> Estimate:
    estimates = {"axes_cm": metrics.axes_cm, "signs": metrics.signs}
    return estimates[name][axis]


def _short(one: Estimate, digits: int, *, interval: bool) -> str:
    value = f"{one.value:.{digits}f}"
    return f"{value} [{one.low:.{digits}f}, {one.high:.{digits}f}]" if interval and one.has_interval else value


def _clips(number: int) -> str:
    return f"{number} clip{'s' * (number != 1)}"


def _table(title: str, first: str) -> Table:
    table = MetricsTable(title)
    table.add_column(first)
    return table


def _row(table: Table, label: str, ratios: list[Estimate]) -> None:
    table.add_row(label, "1.000", *(str(one) for one in ratios))
