"""Evaluations of plans in the world of `worlds`, and synthetic plans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from torch import Tensor

from vjepa2_ac.config.planning import EnergyConfig, LimitsConfig, PlanningConfig
from vjepa2_ac.evaluation.action_score import PlanningStart, planning_start, study_of
from vjepa2_ac.evaluation.evaluate import Contender, evaluate
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import Evaluation, PlanningStudy, Plans
from worlds import about, actions_of, again, clips_batch

ONE_STEP = PlanningConfig(
    samples=200, iterations=12, limits=LimitsConfig(rotation=0.1), energy=EnergyConfig(samples_at_once=400)
)
FEW = ONE_STEP.model_copy(update={"samples": 40, "iterations": 3})
PROBES = ProbeOptions(ranking_clips=0, examples=0, planning_clips=4, planning=ONE_STEP)
QUICK = replace(PROBES, planning=FEW)  # where it does not matter how good a plan is


def small_actions(clips: int = 4) -> Tensor:
    """Return actions that no limit cuts."""
    return actions_of(clips).clamp(-0.045, 0.045)


def planned(
    trained: object, *bases: object, size: int = 4, probes: ProbeOptions = PROBES, actions: Tensor | None = None,
    **changes: object,
) -> Evaluation:  # fmt: skip
    """Return what comes of planning with a model, perhaps beside a base."""
    contenders = [Contender("base", "base", base) for base in bases]  # type: ignore[arg-type]
    contenders.append(Contender("adapter", "trained", trained))  # type: ignore[arg-type]
    tried = small_actions() if actions is None else actions
    batch = clips_batch(len(tried), actions=tried)
    return evaluate(contenders, again(batch, size), about(**changes), probes=probes)


def study(demonstrated: np.ndarray, ids: tuple[str, ...] | None = None) -> PlanningStudy:
    """Return a study of demonstrations that are made up: [starts, 3, 7]."""
    count = len(demonstrated)
    nothing = Plans(np.zeros((1, count, 7)), np.zeros((1, count, 3, 7)))
    names = ids or tuple(f"episode {place}" for place in range(count))
    empty = study_of(starts_of_a_world(), ONE_STEP)
    return replace(
        empty, clips=tuple(range(count)), places=(0,) * count, episode_ids=names, demonstrated=demonstrated,
        zero=nothing, random=nothing, within_limits=Plans(demonstrated[None, :, 0], demonstrated[None]),
    )  # fmt: skip


def starts_of_a_world() -> list[PlanningStart]:
    """Return the starts of four clips."""
    batch = clips_batch(4, actions=small_actions())
    return [planning_start(batch, row, seed=0) for row in range(4)]


def with_plans(evaluation: Evaluation, seed: int = 0, starts: int = 8) -> Evaluation:
    """Return an evaluation whose models have plans that are made up, the later the better."""
    rng = np.random.default_rng(seed)
    demonstrated = 0.04 * rng.standard_normal((starts, 3, 7))
    models = {}
    for place, (name, model) in enumerate(evaluation.models.items()):
        off = 0.04 / (1 + 3 * place) * rng.standard_normal((1, starts, 3, 7))
        models[name] = replace(model, plans=Plans((demonstrated + off)[:, :, 0], demonstrated + off))
    ids = evaluation.clips.episode_ids[:starts]
    return replace(evaluation, models=models, planning=study(demonstrated, ids))
