"""The rows of an evaluation: every number with its interval, once, for console, page, metrics.json and comparison."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

from vjepa2_ac.evaluation.action_score import AXES, PlanMetrics, differences_of, metrics_of, signed_along, ways_of
from vjepa2_ac.evaluation.estimates import (
    Curve,
    cost_of_actions,
    difference_to,
    gain_over,
    gap_of_actions,
    mean_error,
    one_step_over_persistence,
    over_persistence,
    rank_difference,
    stratum_gain,
    stratum_over_persistence,
)
from vjepa2_ac.evaluation.request import BEST_SCORE, STEPS
from vjepa2_ac.evaluation.result import (
    ACTIONS,
    L1,
    MODES,
    PERSISTENCE,
    DecodedRollouts,
    Evaluation,
    Landscapes,
    Metric,
    Mode,
    ModelResult,
    PlanningStudy,
    Plans,
    Row,
)
from vjepa2_ac.intervals import Estimate

MOST_HORIZONS = 8  # on a screen
_TOP = 5  # likewise
_MODES: dict[Mode, str] = {"rollout": "open loop", "teacher_forced": "teacher-forced"}
_SIMILARITIES = {"psnr_db": ("PSNR (dB)", ".1f"), "ssim": ("SSIM", ".3f"), "lpips": ("LPIPS", ".3f")}
_REGIONS = {"whole": "whole image", "moving": "where something moves"}


def rows_of(evaluation: Evaluation) -> list[Row]:
    """Return every number of an evaluation."""
    models = list(evaluation.models.values())
    rows = [*_errors_by_horizon(evaluation), *_distributions(evaluation), *_one_steps(evaluation)]
    for measured in (_sensitivity, _moves):
        rows += [row for model in models for row in measured(evaluation, model)]
    rows += [row for model in models for found in model.beside.values() for row in found.rows(model.name)]
    rows += [row for model in models if model.landscapes for row in _landscapes(model.name, model.landscapes)]
    if evaluation.planning is not None:
        rows += _plans(evaluation, evaluation.planning)
    if evaluation.decoded is not None:
        rows += _decoded(evaluation, evaluation.decoded)
    return [*rows, *(row for found in evaluation.beside.values() for row in found.rows(evaluation.trained))]


@dataclass(frozen=True)
class _Group:
    """Makes the rows of one group."""

    title: str
    key: str

    def line(self, name: str, key: str, found: Mapping[str, Estimate], **style: Any) -> Iterator[Row]:
        """Yield a row for each model."""
        for model, one in found.items():
            yield Row(self.title, name, f"{self.key}.{key}", model, one.value, one.low, one.high, **style)

    def curves(
        self, evaluation: Evaluation, curves: Mapping[str, Curve], shown: set[int] | None = None, **style: Any
    ) -> Iterator[Row]:
        """Yield the rows of curves by horizon, of which some are shown on a screen."""
        for h in range(1, evaluation.horizon + 1):
            name = f"{h * evaluation.about.seconds_per_step:.2f} s ahead"
            found = {model: curve[h - 1] for model, curve in curves.items()}
            yield from self.line(name, str(h), found, detail=h not in (shown or ()), **style)


def _errors_by_horizon(evaluation: Evaluation) -> Iterator[Row]:
    last = evaluation.horizon
    every = -(-last // MOST_HORIZONS)
    shown = {1, *range(every, last + 1, every), last}
    for mode, metric in product(reversed(MODES), evaluation.metrics):
        on_screen = (shown if metric is L1 else {last}) if mode == "rollout" else set()
        yield from _over_persistence(evaluation, mode, metric, on_screen)
    for mode, metric in product(reversed(MODES), evaluation.metrics):
        yield from _compared(evaluation, mode, metric)


def _over_persistence(evaluation: Evaluation, mode: Mode, metric: Metric, shown: set[int]) -> Iterator[Row]:
    better = "lower" if metric.smaller_is_better else "higher"
    errors = {name: model.errors for name, model in evaluation.models.items()}
    for actions in ACTIONS:
        given, key = ("", "") if actions == "true" else (f", {actions} actions", f"_{actions}_actions")
        group = _Group(
            f"{metric.label} error / persistence, {_MODES[mode]}{given}", f"{mode}.{metric.name}.over_persistence{key}"
        )
        curves = {name: over_persistence(one, mode, metric, actions) for name, one in errors.items()}
        on_screen = shown if actions == "true" else None
        yield from group.curves(evaluation, curves, on_screen, better=better, chance=1.0)
    group = _Group(f"{metric.label} error, {_MODES[mode]}", f"{mode}.{metric.name}.error")
    curves = {PERSISTENCE: mean_error(evaluation.errors, mode, metric, "persistence")}
    curves |= {name: mean_error(one, mode, metric) for name, one in errors.items()}
    yield from group.curves(evaluation, curves, form=".4f", better=better)


def _compared(evaluation: Evaluation, mode: Mode, metric: Metric) -> Iterator[Row]:
    """Yield gains over the base and differences to it, paired by clip."""
    base = evaluation.base_errors
    others = {name: model.errors for name, model in evaluation.models.items() if model.errors is not base}
    if base is None:
        return
    key = f"{mode}.{metric.name}"
    gains = {name: gain_over(one, base, mode, metric) for name, one in others.items()}
    group = _Group(f"Gain over the base by {metric.label}, {_MODES[mode]}", f"{key}.gain_over_base")
    yield from group.curves(evaluation, gains, form=".1%", better="higher", chance=0.0)
    differences = {name: difference_to(one, base, mode, metric) for name, one in others.items()}
    group = _Group(f"{metric.label} error minus the base's, {_MODES[mode]}", f"{key}.difference_to_base")
    better = "lower" if metric.smaller_is_better else "higher"
    yield from group.curves(evaluation, differences, form="+.4f", better=better, chance=0.0)


def _distributions(evaluation: Evaluation) -> Iterator[Row]:
    copies = evaluation.persistence_distribution
    found = {name: model.distribution for name, model in evaluation.models.items() if model.distribution is not None}
    if copies is None or not found:
        return
    spread = _Group("Spread / that of the truth, open loop (1: as varied)", "spread")
    curves = {PERSISTENCE: copies.copies.spread} | {name: one.spread for name, one in found.items()}
    yield from spread.curves(evaluation, curves, {evaluation.horizon}, better="")
    for h in range(evaluation.horizon):
        name = f"{(h + 1) * evaluation.about.seconds_per_step:.2f} s ahead"
        floor = copies.noise_floor[h]
        name += "" if math.isnan(floor) else f" (two halves of the truth stay below {floor:.3f})"
        for model, one in {PERSISTENCE: copies.copies, **found}.items():
            mmd, p = one.mmd[h].squared, one.mmd[h].p_value
            yield Row(
                "Squared MMD of latents to the truth, x 100, open loop", name, f"latent_mmd.{h + 1}", model,
                mmd.value, mmd.low, mmd.high, note="" if math.isnan(p) else f"p {p:.3f}", detail=True,
            )  # fmt: skip


def _one_steps(evaluation: Evaluation) -> Iterator[Row]:
    errors = {name: model.errors for name, model in evaluation.models.items()}
    group = _Group("One step, teacher-forced: L1 error / persistence", "one_step")
    for actions in ACTIONS:
        found = {name: one_step_over_persistence(one, actions) for name, one in errors.items()}
        yield from group.line(f"{actions} actions", actions, found, chance=1.0)
    for part in evaluation.strata:
        found = {name: stratum_over_persistence(one, part) for name, one in errors.items()}
        label = f"{part.name} ({int(part.steps.sum())} steps)"
        yield from group.line(label, f"{part.kind}.{part.name}", found, chance=1.0)
    grown = _Group("Growth of the one-step error without the true actions", "cost_of_actions")
    gap = _Group("The same, over the error of persistence", "gap_of_actions")
    for actions in ACTIONS[1:]:
        found = {name: cost_of_actions(one, actions) for name, one in errors.items()}
        style: dict[str, Any] = {"better": "higher", "chance": 0.0, "detail": True}
        yield from grown.line(f"{actions} actions", actions, found, form=".1%", **style)
        found = {name: gap_of_actions(one, actions) for name, one in errors.items()}
        yield from gap.line(f"{actions} actions", actions, found, **style)
    base = evaluation.base_errors
    if base is not None:
        gain = _Group("One-step gain over the base", "one_step_gain")
        others = {name: one for name, one in errors.items() if one is not base}
        for part in evaluation.strata:
            found = {name: stratum_gain(one, base, part) for name, one in others.items()}
            key, style = f"{part.kind}.{part.name}", {"form": ".1%", "better": "higher", "chance": 0.0, "detail": True}
            yield from gain.line(part.name, key, found, **style)


def _sensitivity(evaluation: Evaluation, model: ModelResult) -> Iterator[Row]:
    del evaluation
    if (found := model.sensitivity) is None:
        return
    group = _Group("Use of the actions: others at one step from one frame", "sensitivity")
    change = {model.name: found.change}
    yield from group.line("change with the action / persistence", "change", change, better="higher", chance=0.0)
    for one in found.rankings:
        where = "others' actions" if one.drawn_from == "clips" else "actions in a box"
        rank = {model.name: one.mean_rank}
        yield from group.line(f"share of {where} that fit better", f"rank.{one.drawn_from}", rank, chance=0.5)
        for k, share in one.top.items():
            label, key = f"true action in the best {k} of {one.samples + 1}, {where}", f"top_{k}.{one.drawn_from}"
            style: dict[str, Any] = {"better": "higher", "chance": one.chance_of_top(k), "detail": k != _TOP}
            yield from group.line(label, key, {model.name: share}, **style)


def _moves(evaluation: Evaluation, model: ModelResult) -> Iterator[Row]:
    if (found := model.ranking) is None:
        return
    group, name = _Group("Moves as large as plans: rank of the true action", "ranking"), model.name
    yield from group.line("mean rank", "rank", {name: found.rank}, chance=0.5)
    yield from group.line("among actions in a box", "box", {name: found.box}, chance=0.5)
    yield from group.line("among other directions", "shell", {name: found.shell}, chance=0.5)
    spread = {name: found.spread}
    yield from group.line("spread of the energy / energy now", "spread", spread, better="higher", chance=0.0)
    base = None if evaluation.base is None else evaluation.models[evaluation.base].ranking
    if base is not None and base is not found:
        difference = {name: rank_difference(found, base)}
        style: dict[str, Any] = {"form": "+.3f", "chance": 0.0, "detail": True}
        yield from group.line("mean rank minus the base's", "difference_to_base", difference, **style)


def _landscapes(model: str, found: Landscapes) -> Iterator[Row]:
    unit = f", {found.unit}" if found.unit else ""
    group = _Group(f"Energy landscapes of {_clips(len(found.maps))}", "landscapes")
    label = f"lowest energy to the true action{unit}"
    yield from group.line(label, "distance", {model: found.distance}, chance=found.chance_distance)
    signs = zip(found.axis_names, found.sign_agreement, found.sign_chance, found.sign_clips, strict=True)
    for axis, agreement, chance, count in signs:
        if count:
            label, right = f"its {axis} has the true sign ({_clips(count)})", {model: agreement}
            yield from group.line(label, f"sign.{axis}", right, better="higher", chance=chance)


def _plans(evaluation: Evaluation, study: PlanningStudy) -> Iterator[Row]:
    model_free = {"doing nothing": study.zero, "random": study.random, "within limits": study.within_limits}
    ways = model_free | ways_of(evaluation)
    found = {name: metrics_of(study, plans) for name, plans in ways.items()}
    group = _Group(f"Plans beside demonstrations, from {_clips(len(study))}", "plans")
    for label, key, form, of, detail in _plan_metrics(study):
        numbers = {name: of(metrics) for name, metrics in found.items()}
        better = "higher" if key.startswith(("score", "signs")) else "lower"
        yield from group.line(label, key, numbers, form=form, better=better, detail=detail)
    yield from _plan_differences(evaluation, study, ways)


def _plan_metrics(study: PlanningStudy) -> Iterator[tuple[str, str, str, Any, bool]]:
    """Yield the label, key, format and field of each metric of plans, and whether it is a detail."""

    def field(name: str, axis: int | None = None) -> Any:
        def of(metrics: PlanMetrics) -> Estimate:
            found: Any = getattr(metrics, name)
            one: Estimate = found if axis is None else found[axis]
            return one

        return of

    yield f"Action Score (best {BEST_SCORE:.0f})", "score", ".1f", field("score"), False
    yield f"end of {STEPS} steps off by, cm", "missed_cm", ".1f", field("missed_cm"), False
    yield "its end off, over doing nothing", "missed_over_zero", ".2f", field("missed_over_zero"), True
    yield "one step off by, cm", "step_cm", ".1f", field("step_cm"), False
    yield "one step off, over doing nothing", "step_over_zero", ".2f", field("step_over_zero"), True
    for axis, name in enumerate(AXES):
        yield f"along {name}, cm", f"axes_cm.{name}", ".1f", field("axes_cm", axis), False
    yield "angle, degrees", "angle_degrees", ".0f", field("angle_degrees"), False
    for axis, name in enumerate(AXES):
        if count := int(signed_along(study, axis).sum()):
            yield f"right sign of {name} ({_clips(count)})", f"signs.{name}", ".2f", field("signs", axis), False
    yield "gripper off by", "gripper", ".2f", field("gripper"), False


def _plan_differences(evaluation: Evaluation, study: PlanningStudy, ways: Mapping[str, Plans]) -> Iterator[Row]:
    """Yield the differences of plans to doing nothing and to the base's, paired by start."""
    base = None if evaluation.base is None else evaluation.models[evaluation.base].plans
    for kind, other in (("zero", study.zero), ("base", base)):
        group = _Group(
            f"Plans minus those of {'doing nothing' if kind == 'zero' else 'the base'}", f"plans_minus_{kind}"
        )
        for name in evaluation.models if other is not None else ():
            if name in ways and other is not None and ways[name] is not other:
                found = differences_of(study, ways[name], other)
                yield from group.line(
                    "Action Score", "score", {name: found.score}, form="+.1f", better="higher", detail=True
                )
                yield from group.line("end off by, cm", "missed_cm", {name: found.missed_cm}, form="+.1f", detail=True)
                yield from group.line("one step off by, cm", "step_cm", {name: found.step_cm}, form="+.1f", detail=True)


def _decoded(evaluation: Evaluation, found: DecodedRollouts) -> Iterator[Row]:
    references = ["truth", "decoded_truth"]
    known = {metric for _, metric in found.curves}
    main = next(one for one in references if f"psnr_db.whole.{one}" in known)
    for reference, (name, (label, form)), (region, where) in product(
        references, _SIMILARITIES.items(), _REGIONS.items()
    ):
        metric = f"{name}.{region}.{reference}"
        if metric not in known:
            continue
        group = _Group(
            f"Decoded images against the {reference.replace('_', ' ')}: {label}, {where}", f"decoded.{metric}"
        )
        curves = {source.replace("_", " "): found.curves[source, metric] for source in found.sources}
        better = "lower" if name == "lpips" else "higher"
        shown = {evaluation.horizon} if reference == main else None
        yield from group.curves(evaluation, curves, shown, form=form, better=better)


def _clips(number: int) -> str:
    return f"{number} clip{'s' * (number != 1)}"
