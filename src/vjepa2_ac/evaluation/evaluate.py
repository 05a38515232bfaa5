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
from vjepa2_ac.evaluation.action_score import PlanningStart, measure_plans, planning_start, study_of
from vjepa2_ac.evaluation.action_use import (
    ActionPool,
    LandscapeGrid,
    RolloutStart,
    measure_landscapes,
    measure_sensitivity,
    moves_of,
    pool_of,
    rank_actions,
    start_of,
)
from vjepa2_ac.evaluation.clips import chosen_clips, clips_of, make_example, predicted_rollout, strata_of
from vjepa2_ac.evaluation.distribution import LatentSums, distribution_of, latent_noise_floor
from vjepa2_ac.evaluation.estimates import episode_scores
from vjepa2_ac.evaluation.measure import ALL, Predictor, joined, measured, with_other_actions
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import (
    About,
    ActionRanking,
    Clips,
    Evaluation,
    Example,
    Landscapes,
    Measurement,
    Metric,
    Mode,
    ModelResult,
    PersistenceDistribution,
    Plans,
    PredictionErrors,
    Role,
    Sensitivity,
    Way,
    registered_metrics,
)
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
    metrics: tuple[Metric, ...] | None = None,
    probes: ProbeOptions | None = None,
    reporter: Reporter = SILENT,
) -> Evaluation:
    """Measure models on the same clips.

    Args:
        contenders: In the order of the table; one of them has the role trained.
        clips: What to measure on.
        about: Description of the evaluation.
        metrics: Of the errors, L1 first; None: all that are registered.
        probes: Options of the measurements beyond the errors.
        reporter: Shows the progress of each part of the work.

    Raises:
        ValueError: No clips; or too few frames for planning.
    """
    probes, metrics = probes or ProbeOptions(), metrics or registered_metrics()
    seen = _collect(contenders, clips, probes, about, metrics, reporter.task("measuring"))
    ids, seconds = tuple(seen.ids), about.seconds_per_step
    known = clips_of(seen.actions, ids, tuple(seen.firsts), space=about.space, seconds_per_step=seconds)
    probe = _Probe(seen, known, _pool(seen, about, probes), probes, about, reporter)
    models: dict[str, ModelResult] = {}
    for contender in contenders:
        with contender.switched():
            models[contender.name] = probe.of(contender)
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


@dataclass(frozen=True)
class _Probe:
    """The measurements of one model beyond its predictions; each gives None where nothing was asked for."""

    seen: _Seen
    clips: Clips
    pool: ActionPool
    options: ProbeOptions
    about: About
    reporter: Reporter

    def of(self, contender: Contender) -> ModelResult:
        """Return all results of a model."""
        name, seen = contender.name, self.seen
        return ModelResult(
            name,
            contender.role,
            joined(seen.errors[name]),
            sensitivity=self._sensitivity(contender),
            ranking=self._ranking(contender),
            landscapes=self._landscapes(contender),
            plans=self._plans(contender),
            beside=self._axes(contender),
            distribution=distribution_of(seen.latents.predicted[name], seen.latents.true),
        )

    def _sensitivity(self, contender: Contender) -> Sensitivity | None:
        if not self.seen.starts:
            return None
        progress = self.reporter.task(f"other actions, {contender.name}")
        at_once = self.options.at_once
        return measure_sensitivity(contender.model, self.seen.starts, self.pool, at_once=at_once, progress=progress)

    def _ranking(self, contender: Contender) -> ActionRanking | None:
        if not (moves := self.seen.moves):
            return None
        options, about = self.options, self.about
        pool = pool_of(moves, about.space, reach=options.reach_cm / 100, samples=options.samples, seed=about.seed)
        progress = self.reporter.task(f"action ranking, {contender.name}")
        return rank_actions(contender.model, moves, pool, at_once=options.at_once, progress=progress)

    def _landscapes(self, contender: Contender) -> Landscapes | None:
        starts, options, pool = self.seen.starts, self.options, self.pool
        moving = [start for start in starts if self.clips.moving[start.clip].any()] or starts
        if not options.landscape_clips or not moving or pool.actions.shape[-1] < 3:
            return None
        chosen = [moving[place] for place in spread(len(moving), options.landscape_clips)]
        grid = LandscapeGrid(pool.space, options.nodes, reach=0.0 if pool.space.position is None else pool.reach)
        progress = self.reporter.task(f"energy landscapes, {contender.name}")
        return measure_landscapes(contender.model, chosen, grid, at_once=options.at_once, progress=progress)

    def _plans(self, contender: Contender) -> Plans | None:
        if not self.seen.planned:
            return None
        model = contender.model if contender.to_plan is None else contender.to_plan()
        progress = self.reporter.task(f"planning, {contender.name}")
        return measure_plans(model, self.seen.planned, self.options.planning, progress)

    def _axes(self, contender: Contender) -> dict[str, Measurement]:
        starts, clips = self.seen.starts, self.options.axis_clips
        if self.options.find_axes is None or not starts or not clips or not self.about.space.is_pose:
            return {}
        chosen = [starts[place] for place in spread(len(starts), clips)]
        progress = self.reporter.task(f"axes, {contender.name}")
        return {"axes": self.options.find_axes(contender.model, chosen, self.options.at_once, progress)}


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
