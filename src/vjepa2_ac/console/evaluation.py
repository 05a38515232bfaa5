"""Console output of an evaluation: tables of its metrics."""

from __future__ import annotations

from rich.table import Table

from vjepa2_ac.console.progress import MetricsTable, with_interval
from vjepa2_ac.evaluation.action_score.metrics import AXES, metrics_of, signed_along, ways_of
from vjepa2_ac.evaluation.action_score.protocol import BEST_SCORE, STEPS
from vjepa2_ac.evaluation.axis_fit import AxisFit
from vjepa2_ac.evaluation.decoded.estimates import fvd_of, hand_of, lpips_of, similarity_of, skill_of
from vjepa2_ac.evaluation.decoded.record import NEIGHBOURS, TRUE_FRAMES, DecodedRollouts, Found, Reference
from vjepa2_ac.evaluation.estimates import one_step_over_persistence, over_persistence, stratum_over_persistence
from vjepa2_ac.evaluation.result import ACTIONS, ActionRanking, Evaluation, Landscapes, PlanningStudy, Sensitivity
from vjepa2_ac.evaluation.video.record import FVD_LABEL, NO_I3D, NO_LPIPS
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.reports.comparison import Comparison

_MOST_HORIZONS = 8  # rows; of longer clips some are left out, but are in metrics.json
_TOP = 5


def evaluation_tables(evaluation: Evaluation) -> tuple[Table, ...]:
    """Return the tables of `evaluate`: errors over persistence, then the use of the actions."""
    probed = any(model.sensitivity or model.ranking or model.landscapes for model in evaluation.models.values())
    study = evaluation.planning
    return (
        _errors(evaluation),
        *((_use_of_actions(evaluation),) if probed else ()),
        *((_plans(evaluation, study),) if study is not None else ()),
    )


def decoded_lines(evaluation: Evaluation) -> tuple[str, ...]:
    """Return two lines on the images of the rollouts, and one for each file of a metric; none without a decoder."""
    found = evaluation.decoded
    if found is None:
        return ()
    against: Reference = "decoded_truth" if "truth" in found.absent else "truth"
    sources = (*NEIGHBOURS, *found.models)
    psnr = {name: similarity_of(found, name, against, "whole", "psnr_db")[-1] for name in sources}
    skill = {name: skill_of(found, name, against, "moving", "psnr_db")[-1] for name in found.models}
    hand = {name: hand_of(found, name)[-1] for name in (TRUE_FRAMES, *NEIGHBOURS[:2], *found.models)}
    ahead = f"{evaluation.seconds_ahead:.2g} s ahead"
    lines = [f"Decoded, {ahead}, PSNR against the {against.replace('_', ' ')} (dB): {_named(psnr, '.1f')}."]
    second = f"Skill where something moves (0 persistence, 1 decoded truth): {_named(skill, '.2f')}."
    if found.hand is not None:
        second += f" The hand is off by (px of {found.hand.size}): {_named(hand, '.1f')}."
    return (*lines, second, *_metric_file_lines(found, against, ahead))


def _metric_file_lines(found: DecodedRollouts, against: Reference, ahead: str) -> list[str]:
    """Return LPIPS and FVD if their files were named, or why there is none."""
    sources, reference, lines = (*NEIGHBOURS, *found.models), against.replace("_", " "), []
    if found.lpips is not None:
        lpips = {name: lpips_of(found, name, against)[-1] for name in sources}
        name = f"LPIPS ({found.lpips.backbone})"
        lines.append(f"{name}, {ahead}, against the {reference} (0 identical): {_named(lpips, '.3f')}.")
    elif found.absent.get("lpips", NO_LPIPS) != NO_LPIPS:
        lines.append(f"LPIPS: not measured, {found.absent['lpips']}.")
    if found.fvd is not None:
        fvd = {name: fvd_of(found, name, against).value for name in sources}
        shown = [f"{name.replace('_', ' ')} {value:.1f}" for name, value in fvd.items() if value is not None]
        lines.append(f"{FVD_LABEL} of {found.fvd.clips} clips to the {reference}: {', '.join(shown) or 'none'}.")
    elif found.absent.get("fvd", NO_I3D) != NO_I3D:
        lines.append(f"{FVD_LABEL}: not measured, {found.absent['fvd']}.")
    return lines


def _named(found: dict[str, Found], form: str) -> str:
    shown = {name: "none" if one.estimate is None else f"{one.value:{form}}" for name, one in found.items()}
    return ", ".join(f"{name.replace('_', ' ')} {text}" for name, text in shown.items())


def comparison_table(comparison: Comparison) -> Table:
    """Return the table of `compare`, a row per run."""
    table = MetricsTable(comparison.title, ["run", *comparison.columns])
    forms = [".1%" if column.startswith("gain") else ".3f" for column in comparison.columns]
    for name, cells in comparison.rows.items():
        shown = zip(cells, forms, strict=True)
        table.add_row(name, *(cell if isinstance(cell, str) else with_interval(cell, form) for cell, form in shown))
    return table


def _errors(evaluation: Evaluation) -> Table:
    sure = "95 % interval over episodes" if evaluation.clips.episodes > 1 else "one episode: no interval"
    title = f"Latent error / persistence on held-out episodes ({sure})"
    table = MetricsTable(title, ["open loop, L1", "persistence", *evaluation.models])
    seconds, last = evaluation.about.seconds_per_step, evaluation.horizon
    models = [model.errors for model in evaluation.models.values()]
    curves = [over_persistence(errors, "rollout") for errors in models]

    def row(label: str, ratios: list[Estimate]) -> None:
        table.add_row(label, "1.000", *map(str, ratios))

    for h in range(1, last + 1):
        if h == last or h % -(-last // _MOST_HORIZONS) == 0 or h == 1:
            row(f"{h * seconds:.2f} s ahead", [curve[h - 1] for curve in curves])
    for metric in evaluation.metrics[1:]:
        ratios = [over_persistence(errors, "rollout", metric)[-1] for errors in models]
        row(f"{last * seconds:.2f} s, {metric.heading}", ratios)
    copies = evaluation.persistence_distribution
    found = [model.distribution for model in evaluation.models.values()]
    if copies is not None and all(found):
        spreads = [which.spread[-1] for which in found if which is not None]
        label = f"{last * seconds:.2f} s, spread / that of the truth"
        table.add_row(label, f"{copies.copies.spread[-1].value:.3f}", *map(str, spreads))
    table.add_section()
    for actions in ACTIONS:
        row(f"one step, {actions} actions", [one_step_over_persistence(errors, actions) for errors in models])
    table.add_section()
    for part in evaluation.strata:
        row(f"one step, {part.name}", [stratum_over_persistence(errors, part) for errors in models])
    return table


def _use_of_actions(evaluation: Evaluation) -> Table:
    table = MetricsTable("Use of the actions: one step from one frame", ["", "ignoring them", *evaluation.models])
    sensitivities = [model.sensitivity for model in evaluation.models.values()]
    if all(sensitivities):
        _sensitivity_rows(table, [one for one in sensitivities if one is not None])
    rankings = [model.ranking for model in evaluation.models.values()]
    if all(rankings):
        table.add_section()
        _ranking_rows(table, [one for one in rankings if one is not None])
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


def _ranking_rows(table: Table, models: list[ActionRanking]) -> None:
    table.add_row("moves as large as plans: rank of the true action", "0.500", *(str(one.rank) for one in models))
    table.add_row("  among actions in a box", "0.500", *(str(one.box) for one in models))
    table.add_row("  among other directions", "0.500", *(str(one.shell) for one in models))
    table.add_row("  spread of the energy / energy now", "0.000", *(str(one.spread) for one in models))


def _axes_rows(table: Table, models: list[AxisFit]) -> None:
    label = f"axes: yaw, degrees ({_clips(models[0].pairs)})"
    table.add_row(label, "", *(with_interval(one.yaw_degrees, ".0f") for one in models))
    table.add_row("  error at it / unturned", "1.000", *(str(one.error) for one in models))
    table.add_row("  fitted yaw", "", *(with_interval(one.fitted_yaw_degrees, ".0f") for one in models))
    table.add_row("  gain", "0.000", *(str(one.gain) for one in models))
    table.add_row("  condition", "", *(with_interval(one.condition, ".1f") for one in models))


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
    model_free = {"doing nothing": study.zero, "random": study.random, "within limits": study.within_limits}
    ways = model_free | ways_of(evaluation)
    title = f"Plans beside demonstrations, from {_clips(len(study))} (95 % interval over episodes)"
    table = MetricsTable(title, ["", *ways])
    metrics = [metrics_of(study, plans) for plans in ways.values()]

    def row(label: str, estimates: list[Estimate], form: str = ".1f") -> None:
        named = zip(ways, estimates, strict=True)
        cells = (f"{one.value:{form}}" if name in model_free else with_interval(one, form) for name, one in named)
        table.add_row(label, *cells)

    row(f"Action Score (best {BEST_SCORE:.0f})", [one.score for one in metrics])
    row(f"end of {STEPS} steps off by, cm", [one.missed_cm for one in metrics])
    table.add_section()
    row("one step off by, cm", [one.step_cm for one in metrics])
    for axis, name in enumerate(AXES):
        row(f"  along {name}", [one.axes_cm[axis] for one in metrics])
    row("  angle, degrees", [one.angle_degrees for one in metrics], ".0f")
    for axis, name in enumerate(AXES):
        if count := int(signed_along(study, axis).sum()):
            row(f"  right sign of {name} ({_clips(count)})", [one.signs[axis] for one in metrics], ".2f")
    row("  gripper off by", [one.gripper for one in metrics], ".2f")
    table.add_section()
    table.add_row("seconds a clip", *(f"{one.seconds / len(study):.1f}" * bool(one.seconds) for one in ways.values()))
    return table


def _clips(number: int) -> str:
    return f"{number} clip{'s' * (number != 1)}"
