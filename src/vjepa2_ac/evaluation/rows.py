"""The rows of an evaluation: all numbers and intervals, for console, report, metrics.json and comparison of runs.

PyTorch is not imported.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator

from vjepa2_ac.errors import counted
from vjepa2_ac.evaluation.result import (
    ACTIONS,
    L1,
    PERSISTENCE,
    ActionRanking,
    Curve,
    Evaluation,
    LandscapeMeasure,
    Landscapes,
    cost_of_actions,
    gain_over,
    gap_of_actions,
    one_step_over_persistence,
    over_persistence,
    rank_difference,
)
from vjepa2_ac.intervals import Estimate

_Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]  # null in JSON: NaN
_MAX_HORIZONS = 8  # maximum number of horizons in the console's tables, in addition to the first
_SIMILARITIES = {"psnr_db": ("PSNR (dB)", ".1f"), "ssim": ("SSIM", ".3f")}
_REGIONS = {"whole": "whole image", "moving": "moving region"}
_GAIN: dict[str, Any] = {"form": ".1%", "better": "higher", "chance": 0.0}


@dataclass(frozen=True)
class Row:
    """One number of an evaluation with its interval. Rows with the same key are one line of a table."""

    group: str  # title of the table
    name: str  # label of the line
    key: str  # identifies the table and the line in metrics.json, such as rollout.l1.over_persistence.3
    model: str  # column of the table: the name of a model, or persistence
    value: _Number  # NaN: not measured
    low: _Number = math.nan  # 95 % interval over episodes; NaN: there is none
    high: _Number = math.nan
    form: str = ".3f"  # format of the value
    better: Literal["lower", "higher", ""] = "lower"
    chance: float | None = None  # value of persistence, or of a model that ignores its actions
    unit: str = ""  # unit of the value, such as cm
    detail: bool = False  # whether the console leaves the row out

    @property
    def estimate(self) -> Estimate:
        """The number with its interval."""
        return Estimate(self.value, self.low, self.high)

    def __str__(self) -> str:
        return "not measured" if math.isnan(self.value) else f"{self.estimate:{self.form}}"


@dataclass(frozen=True)
class RowTable:
    """The rows of one group as a table."""

    title: str
    columns: tuple[str, ...]
    better: tuple[str, ...]  # direction of each line: "lower", "higher", or "" if neither is better
    lines: tuple[tuple[str, str, tuple[str, ...]], ...]  # label, value of persistence or of chance, cell of each column


def arrange_tables(rows: Sequence[Row]) -> list[RowTable]:
    """Arrange rows as tables. Rows with the same key form one line, with a column for each model."""
    by_key: dict[str, dict[str, Row]] = {}
    for row in rows:
        by_key.setdefault(row.key, {})[row.model] = row
    groups: dict[str, list[dict[str, Row]]] = {}
    for line in by_key.values():
        groups.setdefault(next(iter(line.values())).group, []).append(line)
    return [_make_table(title, lines) for title, lines in groups.items()]


def _make_table(title: str, lines: Sequence[Mapping[str, Row]]) -> RowTable:
    columns = tuple(dict.fromkeys(model for line in lines for model in line if model != PERSISTENCE))
    cells = []
    for line in lines:
        first = next(iter(line.values()))
        chance = "" if first.chance is None else f"{first.chance:{first.form}}"
        chance = str(line.get(PERSISTENCE, chance))
        cells.append((first.name, chance, tuple(str(line.get(model, "")) for model in columns)))
    better = tuple(next(iter(line.values())).better for line in lines)
    return RowTable(title, columns, better, tuple(cells))


def make_rows(evaluation: Evaluation) -> list[Row]:
    """Return every number of an evaluation."""
    rows = _Rows(evaluation)
    rows.add_errors()
    rows.add_distributions()
    rows.add_teacher_forced_rows()
    for model in evaluation.models.values():
        if model.ranking is not None:
            rows.add_ranking(model.name, model.ranking)
    for model in evaluation.models.values():
        if model.landscapes is not None:
            rows.add_landscapes(model.name, model.landscapes)
    rows.add_decoded()
    return list(rows)


class _Rows(list[Row]):
    """A list of rows, with a method for each measurement that adds its rows."""

    def __init__(self, evaluation: Evaluation) -> None:
        super().__init__()
        self.evaluation = evaluation
        self.errors = {name: model.errors for name, model in evaluation.models.items()}
        self.base = None if evaluation.base is None else evaluation.models[evaluation.base]

    def add_line(self, group: str, name: str, key: str, values: Mapping[str, Estimate], **style: Any) -> None:
        """Add one line of a table: a row for each model."""
        self.extend(
            Row(group, name, key, model, estimate.value, estimate.low, estimate.high, **style)
            for model, estimate in values.items()
        )

    def add_curves(
        self, group: str, key: str, curves: Mapping[str, Curve], shown: Collection[int] = (), **style: Any
    ) -> None:
        """Add a line for each horizon. Horizons that are not in `shown` are left out on the console."""
        for h in range(1, self.evaluation.horizon + 1):
            values = {model: curve[h - 1] for model, curve in curves.items()}
            name = f"{h * self.evaluation.about.seconds_per_step:.2f} s ahead"
            self.add_line(group, name, f"{key}.{h}", values, detail=h not in shown, **style)

    def add_errors(self) -> None:
        """Add the rollout errors relative to persistence, and the gains over the base model, paired by clip."""
        last = self.evaluation.horizon
        every = -(-last // _MAX_HORIZONS)
        for metric in self.evaluation.metrics:
            shown = {1, *range(every, last + 1, every), last} if metric is L1 else {last}
            curves = {name: over_persistence(errors, "rollout", metric) for name, errors in self.errors.items()}
            group, key = (
                f"{metric.label} error relative to persistence, open loop (ratio)",
                f"rollout.{metric.name}.over_persistence",
            )
            better = "lower" if metric.smaller_is_better else "higher"
            self.add_curves(group, key, curves, shown, better=better, chance=1.0)
        if self.base is None:
            return
        base = self.base.errors
        compared = {name: errors for name, errors in self.errors.items() if name != self.base.name}
        for metric in self.evaluation.metrics:
            gains = {name: gain_over(errors, base, "rollout", metric) for name, errors in compared.items()}
            group, key = (
                f"Improvement over the base model in {metric.label}, open loop",
                f"rollout.{metric.name}.gain_over_base",
            )
            self.add_curves(group, key, gains, **_GAIN)

    def add_distributions(self) -> None:
        """Add spread, MMD and Fréchet distance of the latents."""
        evaluation, clips = self.evaluation, self.evaluation.clips
        models = {
            name: model.distribution for name, model in evaluation.models.items() if model.distribution is not None
        }
        if evaluation.copies is None or not models:
            return
        distributions = {PERSISTENCE: evaluation.copies, **models}
        spreads, last = {name: each.spread for name, each in distributions.items()}, {evaluation.horizon}
        self.add_curves(
            "Spread of the predictions, open loop (relative to the true latents; 1: as varied as these)",
            "spread",
            spreads,
            last,
            better="",
        )
        sample_size = f"{counted(len(clips), 'clip')} of {counted(clips.episodes, 'episode')}"
        group = f"Squared MMD between predicted and true latents x 100, open loop ({sample_size}; unbiased)"
        self.add_curves(group, "latent_mmd", {name: each.mmd for name, each in distributions.items()})
        by_chance = evaluation.fvd_of_halves
        halves = f"; between two halves of the true clips: {by_chance:.3g}" if math.isfinite(by_chance) else ""
        group = f"Fréchet distance between predicted and true latents (FVD; {sample_size}; biased upwards{halves})"
        style: dict[str, Any] = {"form": ".3g", "detail": True}
        distances = {name: each.fvd for name, each in distributions.items()}
        self.add_line(group, "predicted frames", "fvd.predicted", _without_intervals(distances), **style)
        if evaluation.decoded is not None and evaluation.decoded.fvd:
            self.add_line(group, "decoded frames", "fvd.decoded", _without_intervals(evaluation.decoded.fvd), **style)

    def add_teacher_forced_rows(self) -> None:
        """Add teacher-forced errors of one step: with zero and shuffled actions, and for moving and idle steps."""
        group, moving = (
            "One-step L1 error relative to persistence, teacher-forced (ratio)",
            self.evaluation.clips.moving,
        )
        for actions in ACTIONS:
            ratios = {name: one_step_over_persistence(errors, actions) for name, errors in self.errors.items()}
            self.add_line(group, f"{actions} actions", f"one_step.{actions}", ratios, chance=1.0)
        for name, steps in (("moving", moving), ("idle", ~moving)):
            if steps.any():
                ratios = {
                    model: one_step_over_persistence(errors, "true", steps) for model, errors in self.errors.items()
                }
                label = f"{name} ({counted(int(steps.sum()), 'step')})"
                self.add_line(group, label, f"one_step.{name}", ratios, chance=1.0)
        increase = "Increase of the one-step error without the true actions"
        relative_increase = "Increase of the one-step error without the true actions, relative to persistence (ratio)"
        for actions in ACTIONS[1:]:
            name = f"{actions} actions"
            costs = {model: cost_of_actions(errors, actions) for model, errors in self.errors.items()}
            self.add_line(increase, name, f"cost_of_actions.{actions}", costs, detail=True, **_GAIN)
            gaps = {model: gap_of_actions(errors, actions) for model, errors in self.errors.items()}
            self.add_line(
                relative_increase, name, f"gap_of_actions.{actions}", gaps, detail=True, **(_GAIN | {"form": ".3f"})
            )

    def add_ranking(self, model: str, ranking: ActionRanking) -> None:
        """Add the action-ranking error, and how much prediction and energy change with the action."""
        group = "Action-ranking error: fraction of alternative actions with a lower energy than the true action"
        style: dict[str, Any] = {"form": ".1%", "chance": 0.5}
        self.add_line(group, "all alternatives", "ranking.rank", {model: ranking.rank}, **style)
        self.add_line(
            group, "alternatives drawn within the range of actions", "ranking.box", {model: ranking.box}, **style
        )
        self.add_line(
            group, "alternatives with the length of the true action", "ranking.shell", {model: ranking.shell}, **style
        )
        for key, label, estimate in (
            ("change", "change of the prediction with the action, relative to persistence", ranking.change),
            ("spread", "spread of the energy over actions, relative to persistence", ranking.spread),
        ):
            self.add_line(group, label, f"ranking.{key}", {model: estimate}, better="higher", chance=0.0)
        base = None if self.base is None else self.base.ranking
        if base is not None and base is not ranking:
            label, difference = (
                "all alternatives, difference from the base model",
                {model: rank_difference(ranking, base)},
            )
            self.add_line(group, label, "ranking.difference_to_base", difference, form="+.1%", chance=0.0, detail=True)

    def add_landscapes(self, model: str, landscapes: Landscapes) -> None:
        """Add the distance of the energy minimum, the rank, the sharpness, and the differences from the base model."""
        group, unit = f"Energy landscapes of {counted(len(landscapes.maps), 'clip')}", landscapes.unit
        labels: dict[LandscapeMeasure, tuple[str, dict[str, Any]]] = {
            "distance": (
                f"distance of the energy minimum from the true action{f' ({unit})' if unit else ''}",
                {"chance": landscapes.chance_distance, "unit": unit},
            ),
            "rank": (
                "rank: fraction of grid points with a lower energy than the true action",
                {"form": ".1%", "chance": 0.5},
            ),
            "sharpness": ("sharpness: (highest - lowest) / mean energy (ratio)", {"better": "higher", "chance": 0.0}),
        }
        base = None if self.base is None else self.base.landscapes
        for measure in get_args(LandscapeMeasure):
            label, style = labels[measure]
            key, detail = f"landscapes.{measure}", measure == "rank"
            self.add_line(group, label, key, {model: landscapes.mean(measure)}, detail=detail, **style)
            if base is not None and base is not landscapes:
                difference = {model: landscapes.difference(base, measure)}
                style = {"form": "+.1%" if measure == "rank" else "+.3f", "better": style.get("better", "lower")}
                name = f"{measure}, difference from the base model"
                self.add_line(group, name, f"{key}.difference_to_base", difference, chance=0.0, detail=True, **style)

    def add_decoded(self) -> None:
        """Add the metrics of decoded rollouts."""
        if (decoded := self.evaluation.decoded) is None:
            return
        references, measured = ("truth", "decoded_truth"), {metric for _, metric in decoded.curves}
        shown_reference = next(reference for reference in references if f"psnr_db.whole.{reference}" in measured)
        combinations = product(references, _SIMILARITIES.items(), _REGIONS.items())
        for reference, (name, (label, form)), (region, region_label) in combinations:
            metric = f"{name}.{region}.{reference}"
            if metric in measured:
                group = f"Decoded images compared with the {reference.replace('_', ' ')}: {label}, {region_label}"
                curves = {source.replace("_", " "): decoded.curves[source, metric] for source in decoded.sources}
                shown = {self.evaluation.horizon} if reference == shown_reference else ()
                self.add_curves(group, f"decoded.{metric}", curves, shown, form=form, better="higher")


def _without_intervals(values: Mapping[str, float]) -> dict[str, Estimate]:
    return {name.replace("_", " "): Estimate(value, math.nan, math.nan) for name, value in values.items()}
