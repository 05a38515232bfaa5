"""Evaluation of models: a trained model, its base and others on the same clips of held-out episodes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, UInt8

from vjepa2_ac.data.windows import spread
from vjepa2_ac.episode import LatentBatch, Progress
from vjepa2_ac.evaluation.action_score.measure import PlanningStart, measure_plans, planning_start, study_of
from vjepa2_ac.evaluation.action_use.energy_landscape import LandscapeGrid, measure_landscapes
from vjepa2_ac.evaluation.action_use.inferred_moves import infer_axes
from vjepa2_ac.evaluation.action_use.one_step import RolloutStart, moves_of, start_of
from vjepa2_ac.evaluation.action_use.ranking import pool_of, rank_actions
from vjepa2_ac.evaluation.action_use.sensitivity import ActionPool, measure_sensitivity
from vjepa2_ac.evaluation.axis_fit import AxisFit
from vjepa2_ac.evaluation.distribution.latent_sums import LatentSums, distribution_of, latent_noise_floor
from vjepa2_ac.evaluation.estimates import episode_scores
from vjepa2_ac.evaluation.examples import chosen_clips, make_example, predicted_rollout
from vjepa2_ac.evaluation.measure import ALL, Predictor, joined, measured, with_other_actions
from vjepa2_ac.evaluation.metrics import METRICS, Metric
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import (
    About,
    ActionRanking,
    Clips,
    Evaluation,
    Example,
    Landscapes,
    Mode,
    ModelResult,
    PersistenceDistribution,
    Plans,
    PredictionErrors,
    Role,
    Sensitivity,
    Way,
)
from vjepa2_ac.evaluation.strata import clips_of, strata_of
from vjepa2_ac.reporter import SILENT, Reporter

ClipName = tuple[str, int]  # id of the episode, first control step
FramesOfRow = Callable[[int], UInt8[np.ndarray, "time height width 3"] | None]  # of a row of the current batch
_NOT_ASKED = "{} is 0: no {} were asked for."
_NO_PLANS = "No plans: they are poses' displacements, and the states here are plain numbers."
_NO_LANDSCAPES = "No energy landscapes: an action has {} numbers, and a landscape is over three."


@dataclass(frozen=True)
class Contender:
    """A model to measure."""

    name: str
    role: Role
    model: Predictor
    switched: Callable[[], contextlib.AbstractContextManager[object]] = contextlib.nullcontext  # while it predicts
    to_plan: Callable[[], Predictor] | None = None  # returns the model that plans in its place, held only for that time


@dataclass(frozen=True)
class RepeatableClips:
    """Clips that can be read repeatedly: all of them, or some by name; batches of latents with their frames."""

    count: int
    read: Callable[[Sequence[ClipName] | None], Iterable[tuple[LatentBatch, FramesOfRow]]]


def evaluate(
    contenders: Sequence[Contender],
    clips: RepeatableClips,
    about: About,
    *,
    metrics: tuple[Metric, ...] = METRICS,
    probes: ProbeOptions | None = None,
    reporter: Reporter = SILENT,
) -> Evaluation:
    """Measure models on the same clips.

    Args:
        contenders: In the order of the table; one of them has the role trained.
        clips: What to measure on.
        about: Description of the evaluation.
        metrics: Of the errors; the first one is L1.
        probes: Options of the measurements beyond the errors.
        reporter: Shows the progress of each part of the work.

    Raises:
        ValueError: No clips; or too few frames for planning.
    """
    probes = probes or ProbeOptions()
    seen = _collect(contenders, clips, probes, about, metrics, reporter.task("measuring"))
    ids, seconds = tuple(seen.ids), about.seconds_per_step
    known = clips_of(seen.actions, ids, tuple(seen.firsts), space=about.space, seconds_per_step=seconds)
    pool = _pool(seen, about, probes)
    models: dict[str, ModelResult] = {}
    for contender in contenders:
        result = _predictions(contender, seen)
        with contender.switched():
            models[contender.name] = replace(
                result,
                sensitivity=_sensitivity(contender, seen.starts, pool, probes, reporter),
                ranking=_ranking(contender, seen.moves, about, probes, reporter),
                landscapes=_landscapes(contender, seen.starts, known, pool, probes, reporter),
                plans=_plans(contender, seen.planned, probes, reporter),
                axes=_axes(contender, seen.starts, about, probes, reporter),
            )
    evaluation = Evaluation(
        about=about,
        clips=known,
        models=models,
        strata=strata_of(known, about.space),
        episodes=(),
        examples=(),
        planning=study_of(seen.planned, probes.planning) if seen.planned else None,
        metrics=metrics,
        persistence_distribution=seen.latents.of_persistence(),
    )
    scores = episode_scores(evaluation.errors, evaluation.base_errors)
    examples = _examples(contenders, clips, evaluation, probes)
    notes = _left_out(probes, about, action_dim=seen.actions.shape[-1])
    return replace(evaluation, episodes=scores, examples=examples, notes=notes)


def _pool(seen: _Seen, about: About, probes: ProbeOptions) -> ActionPool:
    return ActionPool(
        actions=seen.actions.reshape(-1, seen.actions.shape[-1]),
        episode_ids=tuple(np.repeat(np.array(seen.ids), seen.actions.shape[1]).tolist()),
        space=about.space,
        reach=probes.reach_cm / 100,
        samples=probes.samples,
        seed=about.seed,
    )


def _predictions(contender: Contender, seen: _Seen) -> ModelResult:
    """Return what the predictions of all clips gave: their errors, and how they are distributed."""
    distribution = distribution_of(seen.latents.predicted[contender.name], seen.latents.true)
    return ModelResult(contender.name, contender.role, joined(seen.errors[contender.name]), distribution=distribution)


def _left_out(probes: ProbeOptions, about: About, *, action_dim: int) -> tuple[str, ...]:
    """Return notes on what was not measured: by an option, or because it does not apply."""
    notes = []
    if not probes.sensitivity_clips:
        notes.append(_NOT_ASKED.format("--sensitivity-clips", "other actions and no energy landscapes"))
    elif not probes.landscape_clips:
        notes.append(_NOT_ASKED.format("--landscapes", "energy landscapes"))
    elif action_dim < 3:
        notes.append(_NO_LANDSCAPES.format(action_dim))
    if probes.sensitivity_clips and not probes.axis_clips and about.space.is_pose:
        notes.append(_NOT_ASKED.format("--axes", "calibrated axes"))
    if probes.planning_clips and about.space.position is None:
        notes.append(_NO_PLANS)
    if not probes.examples:
        notes.append(_NOT_ASKED.format("--examples", "example clips"))
    return tuple(notes)


class _Latents:
    """Sums of the rollouts of every model with the true actions, of copies of frame 0, and of the true latents."""

    def __init__(self, models: Sequence[str]) -> None:
        self.predicted = {name: LatentSums() for name in models}
        self.copies = LatentSums()
        self.true = LatentSums()
        self._first = models[0]

    def add(self, model: str, ids: Sequence[str], way: Way, mode: Mode, predicted: torch.Tensor) -> None:
        """Add one model's prediction of a batch; copies are the same for all models."""
        if (way, mode) == ("true", "rollout"):
            self.predicted[model].add(predicted, ids)
        elif (way, mode, model) == ("persistence", "rollout", self._first):
            self.copies.add(predicted, ids)

    def of_persistence(self) -> PersistenceDistribution:
        """Return how copies of frame 0 are distributed, and the noise floor."""
        return PersistenceDistribution(distribution_of(self.copies, self.true), latent_noise_floor(self.true))


@dataclass
class _Seen:
    """Data of all clips: errors and actions, and one frame and the next of some."""

    ids: list[str]
    firsts: list[int]
    actions: Float[np.ndarray, "clips horizon action_dim"]
    errors: dict[str, list[PredictionErrors]]  # by model
    starts: list[RolloutStart]
    latents: _Latents
    moves: list[RolloutStart] = field(default_factory=list)
    planned: list[PlanningStart] = field(default_factory=list)


def _collect(
    contenders: Sequence[Contender],
    clips: RepeatableClips,
    probes: ProbeOptions,
    about: About,
    metrics: Sequence[Metric],
    progress: Progress,
) -> _Seen:
    names = [contender.name for contender in contenders]
    seen = _Seen([], [], np.zeros((0, 0, 0)), {name: [] for name in names}, [], _Latents(names))
    actions = []
    probed = set(spread(clips.count, probes.sensitivity_clips)) if probes.sensitivity_clips else set()
    planned = (
        set(spread(clips.count, probes.planning_clips))
        if probes.planning_clips and about.space.position is not None
        else set()
    )
    for batch, others in with_other_actions(batch for batch, _ in clips.read(None)):
        seen.latents.true.add(batch.latents[:, 1:], batch.episode_ids)
        for contender in contenders:
            watch = partial(seen.latents.add, contender.name, batch.episode_ids)
            with contender.switched():
                seen.errors[contender.name].append(measured(contender.model, batch, ALL, metrics, others, watch))
        first = len(seen.ids)
        for row in range(len(batch.starts)):
            if first + row in probed:
                seen.starts.append(start_of(batch, row, _largest_step(batch.actions[row], about), first + row))
                seen.moves += moves_of(batch, row, first + row, about.space, probes.reach_cm / 100)
            if first + row in planned:
                seen.planned.append(planning_start(batch, row, first + row, about.seed))
        actions.append(batch.actions.cpu().numpy().astype(np.float64))
        seen.ids += batch.episode_ids
        seen.firsts += batch.starts
        progress(len(seen.ids), clips.count)
    if not seen.ids:
        raise ValueError("no clips to evaluate on")
    seen.actions = np.concatenate(actions)
    return seen


def _largest_step(actions: Float[torch.Tensor, "time action_dim"], about: About) -> int:
    """Return the step of a clip with the largest action: for poses, by the translation."""
    return int(actions[:, about.space.sized].norm(dim=-1).argmax())


def _sensitivity(
    contender: Contender, starts: Sequence[RolloutStart], pool: ActionPool, probes: ProbeOptions, reporter: Reporter
) -> Sensitivity | None:
    if not starts:
        return None
    progress = reporter.task(f"other actions, {contender.name}")
    return measure_sensitivity(contender.model, starts, pool, at_once=probes.at_once, progress=progress)


def _ranking(
    contender: Contender, moves: Sequence[RolloutStart], about: About, probes: ProbeOptions, reporter: Reporter
) -> ActionRanking | None:
    if not moves:
        return None
    pool = pool_of(moves, about.space, reach=probes.reach_cm / 100, samples=probes.samples, seed=about.seed)
    progress = reporter.task(f"action ranking, {contender.name}")
    return rank_actions(contender.model, moves, pool, at_once=probes.at_once, progress=progress)


def _landscapes(
    contender: Contender,
    starts: Sequence[RolloutStart],
    clips: Clips,
    pool: ActionPool,
    probes: ProbeOptions,
    reporter: Reporter,
) -> Landscapes | None:
    moving = [start for start in starts if clips.moving[start.clip].any()] or list(starts)
    if not probes.landscape_clips or not moving or pool.actions.shape[-1] < 3:
        return None
    chosen = [moving[place] for place in spread(len(moving), probes.landscape_clips)]
    grid = LandscapeGrid(pool.space, probes.nodes, reach=0.0 if pool.space.position is None else pool.reach)
    progress = reporter.task(f"energy landscapes, {contender.name}")
    return measure_landscapes(contender.model, chosen, grid, at_once=probes.at_once, progress=progress)


def _axes(
    contender: Contender, starts: Sequence[RolloutStart], about: About, probes: ProbeOptions, reporter: Reporter
) -> AxisFit | None:
    if not starts or not probes.axis_clips or not about.space.is_pose:
        return None
    chosen = [starts[place] for place in spread(len(starts), probes.axis_clips)]
    progress = reporter.task(f"axes, {contender.name}")
    return infer_axes(contender.model, chosen, at_once=probes.at_once, progress=progress)


def _plans(
    contender: Contender,
    starts: Sequence[PlanningStart],
    probes: ProbeOptions,
    reporter: Reporter,
) -> Plans | None:
    if not starts:
        return None
    model = contender.model if contender.to_plan is None else contender.to_plan()
    return measure_plans(model, starts, probes.planning, reporter.task(f"planning, {contender.name}"))


def _examples(
    contenders: Sequence[Contender], clips: RepeatableClips, evaluation: Evaluation, probes: ProbeOptions
) -> tuple[Example, ...]:
    """Read the clips of the examples again: which ones these are is known only now."""
    known = evaluation.clips
    chosen = chosen_clips(evaluation.errors, known.action_size.sum(axis=1), probes.examples)
    if not chosen:
        return ()
    names = [(known.episode_ids[clip], known.starts[clip]) for clip in chosen]
    reasons = dict(zip(names, chosen.values(), strict=True))
    found = {}
    for batch, frames_of_row in clips.read(names):
        for row, name in enumerate(zip(batch.episode_ids, batch.starts, strict=True)):
            predicted = {}
            for contender in contenders:
                with contender.switched():
                    predicted[contender.name] = predicted_rollout(contender.model, batch, row)
            found[name] = make_example(reasons[name], batch, row, predicted, frames_of_row(row))
    return tuple(found[name] for name in names if name in found)
