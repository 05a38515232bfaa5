"""The rows of an evaluation: every number with its interval, once, for console, page, metrics.json and comparison."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from itertools import product
from typing import Any

from vjepa2_ac.errors import counted
from vjepa2_ac.evaluation.action_score import AXES, differences_of, metrics_of, signed_along, ways_of
from vjepa2_ac.evaluation.estimates import (
    Curve,
    cost_of_actions,
    difference_to,
    distance_difference,
    gain_over,
    gap_of_actions,
    mean_error,
    one_step_over_persistence,
    over_persistence,
    rank_difference,
    stratum_gain,
)
from vjepa2_ac.evaluation.request import BEST_SCORE, STEPS
from vjepa2_ac.evaluation.result import (
    ACTIONS,
    L1,
    MODES,
    PERSISTENCE,
    ActionRanking,
    Evaluation,
    Landscapes,
    Metric,
    Mode,
    Row,
)
from vjepa2_ac.intervals import Estimate

MOST_HORIZONS = 8  # on a screen
_MODES: dict[Mode, str] = {"rollout": "open loop", "teacher_forced": "teacher-forced"}
_SIMILARITIES = {"psnr_db": ("PSNR (dB)", ".1f"), "ssim": ("SSIM", ".3f"), "lpips": ("LPIPS", ".3f")}
_REGIONS = {"whole": "whole image", "moving": "where something moves"}
_PLANS = {  # label, format, and whether it is a detail
    "score": (f"Action Score (best {BEST_SCORE:.0f})", ".1f", False),
    "missed_cm": (f"end of {STEPS} steps off by, cm", ".1f", False),
    "missed_over_zero": ("its end off, over the zero action", ".2f", True),
    "step_cm": ("one step off by, cm", ".1f", False),
    "step_over_zero": ("one step off, over the zero action", ".2f", True),
    **{f"axes_cm.{name}": (f"along {name}, cm", ".1f", False) for name in AXES},
    "angle_degrees": ("angle, degrees", ".0f", False),
    **{f"signs.{name}": (f"right sign of {name}", ".2f", False) for name in AXES},
    "gripper": ("gripper off by", ".2f", False),
}
_PLAN_DIFFERENCES = {"score": "Action Score", "missed_cm": "end off by, cm", "step_cm": "one step off by, cm"}
_GAIN: dict[str, Any] = {"form": ".1%", "better": "higher", "chance": 0.0}


def rows_of(evaluation: Evaluation) -> list[Row]:
    """Return every number of an evaluation."""
    rows, models = _Rows(evaluation), evaluation.models.values()
    for mode, metric in product(reversed(MODES), evaluation.metrics):
        rows.add_errors(mode, metric)
    for mode, metric in product(reversed(MODES), evaluation.metrics):
        rows.add_comparison(mode, metric)
    rows.add_distributions()
    rows.add_one_steps()
    for model in models:
        if model.ranking is not None:
            rows.add_ranking(model.name, model.ranking)
    rows += [row for model in models for found in model.beside.values() for row in found.rows(model.name)]
    for model in models:
        if model.landscapes is not None:
            rows.add_landscapes(model.name, model.landscapes)
    rows.add_plans()
    rows.add_decoded()
    return [*rows, *(row for found in evaluation.beside.values() for row in found.rows(evaluation.trained))]


class _Rows(list[Row]):
    """The rows so far."""

    def __init__(self, evaluation: Evaluation) -> None:
        super().__init__()
        self.evaluation = evaluation
        self.errors = {name: model.errors for name, model in evaluation.models.items()}
        self.base = None if evaluation.base is None else evaluation.models[evaluation.base]
        self.others = {name: one for name, one in self.errors.items() if name != evaluation.base}

    def line(self, group: str, name: str, key: str, found: Mapping[str, Estimate], **style: Any) -> None:
        """Add a row for each model."""
        self.extend(Row(group, name, key, model, one.value, one.low, one.high, **style) for model, one in found.items())

    def curves(
        self, group: str, key: str, curves: Mapping[str, Curve], shown: Collection[int] = (), **style: Any
    ) -> None:
        """Add the rows of curves by horizon, of which some are shown on a screen."""
        for h in range(1, self.evaluation.horizon + 1):
            found = {model: curve[h - 1] for model, curve in curves.items()}
            self.line(group, self.ahead(h), f"{key}.{h}", found, detail=h not in shown, **style)

    def ahead(self, horizon: int) -> str:
        """Return a horizon as text."""
        return f"{horizon * self.evaluation.about.seconds_per_step:.2f} s ahead"

    def add_errors(self, mode: Mode, metric: Metric) -> None:
        """Add the errors over persistence, and the errors."""
        last, better = self.evaluation.horizon, "lower" if metric.smaller_is_better else "higher"
        every = -(-last // MOST_HORIZONS)
        shown = {1, *range(every, last + 1, every), last} if metric is L1 else {last}
        for actions in ACTIONS:
            given, key = ("", "") if actions == "true" else (f", {actions} actions", f"_{actions}_actions")
            curves = {name: over_persistence(one, mode, metric, actions) for name, one in self.errors.items()}
            on_screen = shown if actions == "true" and mode == "rollout" else ()
            group = f"{metric.label} error / persistence, {_MODES[mode]}{given}"
            key = f"{mode}.{metric.name}.over_persistence{key}"
            self.curves(group, key, curves, on_screen, better=better, chance=1.0)
        curves = {PERSISTENCE: mean_error(self.evaluation.errors, mode, metric, "persistence")}
        curves |= {name: mean_error(one, mode, metric) for name, one in self.errors.items()}
        group, key = f"{metric.label} error, {_MODES[mode]}", f"{mode}.{metric.name}.error"
        self.curves(group, key, curves, form=".4f", better=better)

    def add_comparison(self, mode: Mode, metric: Metric) -> None:
        """Add gains over the base and differences to it, paired by clip."""
        if self.base is None:
            return
        base, key = self.base.errors, f"{mode}.{metric.name}"
        gains = {name: gain_over(one, base, mode, metric) for name, one in self.others.items()}
        self.curves(f"Gain over the base by {metric.label}, {_MODES[mode]}", f"{key}.gain_over_base", gains, **_GAIN)
        found = {name: difference_to(one, base, mode, metric) for name, one in self.others.items()}
        group = f"{metric.label} error minus the base's, {_MODES[mode]}"
        better = "lower" if metric.smaller_is_better else "higher"
        self.curves(group, f"{key}.difference_to_base", found, form="+.4f", better=better, chance=0.0)

    def add_distributions(self) -> None:
        """Add spread and MMD of the latents."""
        copies, models = self.evaluation.copies, self.evaluation.models
        found = {name: model.distribution for name, model in models.items() if model.distribution is not None}
        if copies is None or not found:
            return
        found = {PERSISTENCE: copies, **found}
        curves = {name: one.spread for name, one in found.items()}
        group = "Spread / that of the truth, open loop (1: as varied)"
        self.curves(group, "spread", curves, {self.evaluation.horizon}, better="")
        group = "Squared MMD of latents to the truth, x 100, open loop"
        for h, floor in enumerate(self.evaluation.noise_floor, start=1):
            beside = "" if math.isnan(floor) else f" (two halves of the truth stay below {floor:.3f})"
            for model, one in found.items():
                p = one.p_values[h - 1]
                note = "" if math.isnan(p) else f"p {p:.3f}"
                mmd = {model: one.mmd[h - 1]}
                self.line(group, self.ahead(h) + beside, f"latent_mmd.{h}", mmd, note=note, detail=True)

    def add_one_steps(self) -> None:
        """Add teacher-forced errors of one step: with other actions, and by stratum."""
        group = "One step, teacher-forced: L1 error / persistence"
        for actions in ACTIONS:
            found = {name: one_step_over_persistence(one, actions) for name, one in self.errors.items()}
            self.line(group, f"{actions} actions", f"one_step.{actions}", found, chance=1.0)
        for part in self.evaluation.strata:
            found = {name: one_step_over_persistence(one, "true", part) for name, one in self.errors.items()}
            label = f"{part.label} ({counted(int(part.steps.sum()), 'step')})"
            self.line(group, label, f"one_step.{part.key}", found, chance=1.0)
        grown, gap = "Growth of the one-step error without the true actions", "The same, over the error of persistence"
        for actions in ACTIONS[1:]:
            name = f"{actions} actions"
            found = {model: cost_of_actions(one, actions) for model, one in self.errors.items()}
            self.line(grown, name, f"cost_of_actions.{actions}", found, detail=True, **_GAIN)
            found = {model: gap_of_actions(one, actions) for model, one in self.errors.items()}
            style = {**_GAIN, "form": ".3f"}
            self.line(gap, name, f"gap_of_actions.{actions}", found, detail=True, **style)
        if (base := self.evaluation.base_errors) is None:
            return
        for part in self.evaluation.strata:
            found = {name: stratum_gain(one, base, part) for name, one in self.others.items()}
            key = f"one_step_gain.{part.key}"
            self.line("One-step gain over the base", part.label, key, found, detail=True, **_GAIN)

    def add_ranking(self, model: str, found: ActionRanking) -> None:
        """Add the action-ranking error, and how much prediction and energy change with the action."""
        group = "Action-ranking error: alternative actions with a lower energy than the true one"
        share: dict[str, Any] = {"form": ".1%", "chance": 0.5}
        self.line(group, "of all alternatives", "ranking.rank", {model: found.rank}, **share)
        self.line(group, "of those in the box", "ranking.box", {model: found.box}, **share)
        self.line(group, "of those of the same length", "ranking.shell", {model: found.shell}, **share)
        for key, label, one in (
            ("change", "change of the prediction with the action / persistence", found.change),
            ("spread", "spread of the energy / persistence", found.spread),
        ):
            self.line(group, label, f"ranking.{key}", {model: one}, better="higher", chance=0.0)
        base = None if self.base is None else self.base.ranking
        if base is not None and base is not found:
            label, difference = "of all alternatives, minus the base model's", {model: rank_difference(found, base)}
            self.line(group, label, "ranking.difference_to_base", difference, form="+.1%", chance=0.0, detail=True)

    def add_landscapes(self, model: str, found: Landscapes) -> None:
        """Add where the energy is lowest."""
        group, label = f"Energy landscapes of {counted(len(found.maps), 'clip')}", "lowest energy to the true action"
        label += f", {found.unit}" if found.unit else ""
        style: dict[str, Any] = {"chance": found.chance_distance, "unit": found.unit}
        self.line(group, label, "landscapes.distance", {model: found.distance}, **style)
        label, sharpness = "sharpness: (highest - lowest) / mean energy", {model: found.sharpness}
        self.line(group, label, "landscapes.sharpness", sharpness, better="higher", chance=0.0)
        base = None if self.base is None else self.base.landscapes
        if base is not None and base is not found:
            label, difference = "distance minus the base's", {model: distance_difference(found, base)}
            self.line(group, label, "landscapes.difference_to_base", difference, form="+.3f", chance=0.0, detail=True)

    def add_plans(self) -> None:
        """Add the metrics of plans, and their differences to the zero action and to the base's, paired by start."""
        study = self.evaluation.planning
        if study is None:
            return
        models = ways_of(self.evaluation)
        free = {"zero action": study.zero, "random": study.random, "within limits": study.within_limits}
        found = {name: metrics_of(study, plans) for name, plans in (free | models).items()}
        group = f"Plans beside demonstrations, from {counted(len(study.clips), 'clip')}"
        for key, (label, form, detail) in _PLANS.items():
            kind, _, axis = key.partition(".")
            count = int(signed_along(study, AXES.index(axis)).sum()) if kind == "signs" else None
            if count != 0:
                label += "" if count is None else f" ({counted(count, 'clip')})"
                style: dict[str, Any] = {"form": form, "detail": detail}
                style["better"] = "higher" if kind in {"score", "signs"} else "lower"
                self.line(group, label, f"plans.{key}", {name: one[key] for name, one in found.items()}, **style)
        base = None if self.base is None else self.base.plans
        for kind, whose, other in (("zero", "zero action", study.zero), ("base", "the base", base)):
            for name, plans in models.items():
                if other is not None and plans is not other:
                    for key, one in differences_of(study, plans, other).items():
                        group, key_of = f"Plans minus those of {whose}", f"plans_minus_{kind}.{key}"
                        style = {"form": "+.1f", "better": "higher" if key == "score" else "lower", "detail": True}
                        self.line(group, _PLAN_DIFFERENCES[key], key_of, {name: one}, **style)

    def add_decoded(self) -> None:
        """Add the metrics of decoded rollouts."""
        if (found := self.evaluation.decoded) is None:
            return
        references, known = ("truth", "decoded_truth"), {metric for _, metric in found.curves}
        main = next(one for one in references if f"psnr_db.whole.{one}" in known)
        every = product(references, _SIMILARITIES.items(), _REGIONS.items())
        for reference, (name, (label, form)), (region, where) in every:
            metric = f"{name}.{region}.{reference}"
            if metric in known:
                group = f"Decoded images against the {reference.replace('_', ' ')}: {label}, {where}"
                curves = {source.replace("_", " "): found.curves[source, metric] for source in found.sources}
                shown = {self.evaluation.horizon} if reference == main else ()
                better = "lower" if name == "lpips" else "higher"
                self.curves(group, f"decoded.{metric}", curves, shown, form=form, better=better)
