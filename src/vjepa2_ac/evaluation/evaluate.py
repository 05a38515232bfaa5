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
    RolloutStart,
    measure_landscapes,
    measure_sensitivity,
    moves_of,
    rank_actions,
    start_of,
)
from vjepa2_ac.evaluation.clips import chosen_clips, clips_of, make_example, strata_of
from vjepa2_ac.evaluation.distribution import LatentSums, distribution_of, latent_noise_floor
from vjepa2_ac.evaluation.estimates import episode_scores
from vjepa2_ac.evaluation.measure import ALL, Predictor, joined, measured, prediction, with_other_actions
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import (
    About,
    Clips,
    Evaluation,
    Example,
    Metric,
    Mode,
    ModelResult,
    PredictionErrors,
    Role,
    Way,
    registered_metrics,
)
from vjepa2_ac.reporter import SILENT, Reporter

ClipName = tuple[str, int]  # id of the episode, first control step
FramesOfRow = Callable[[int], UInt8[np.ndarray, "time height width 3"] | None]  # of a row of the current batch


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
    has_frames: bool = True  # False: of cached latents there are only small ones


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
        clips: What to measure on; one or more.
        about: Description of the evaluation.
        metrics: Of the errors, L1 first; None: all that are registered.
        probes: Options of the measurements beyond the errors.
        reporter: Shows the progress of each part of the work.

    Raises:
        ValueError: Too few frames for planning.
    """
    probes, metrics = probes or ProbeOptions(), metrics or registered_metrics()
    seen = _collect(contenders, clips, probes, about, metrics, reporter.task("measuring"))
    ids = tuple(seen.ids)
    known = clips_of(seen.actions, ids, tuple(seen.firsts), space=about.space, seconds_per_step=about.seconds_per_step)
    models: dict[str, ModelResult] = {}
    for contender in contenders:
        with contender.switched():
            models[contender.name] = _measure(contender, seen, known, probes, about, reporter)
    evaluation = Evaluation(
        about=about,
        clips=known,
        models=models,
        strata=strata_of(known, about.space),
        episodes=(),
        examples=(),
        planning=study_of(seen.planned, probes.planning) if seen.planned else None,
        metrics=metrics,
        copies=distribution_of(seen.copies, seen.true),
        noise_floor=latent_noise_floor(seen.true),
    )
    notes, width = [], seen.actions.shape[-1]
    if probes.sensitivity_clips and probes.landscape_clips and width < 3:
        notes.append(f"No energy landscapes: an action has {width} numbers, and a landscape is over three.")
    if probes.planning_clips and about.space.position is None:
        notes.append("No plans: they are poses' displacements, and the states here are plain numbers.")
    return replace(
        evaluation,
        episodes=episode_scores(evaluation.errors, evaluation.base_errors),
        examples=_examples(contenders, clips, evaluation, probes.examples),
        notes=tuple(notes),
    )


@dataclass
class _Seen:
    """What all clips gave: errors, actions, sums of latents, and one frame and the next of some."""

    errors: dict[str, list[PredictionErrors]]  # by model
    predicted: dict[str, LatentSums]  # rollouts with the true actions, by model
    actions: Float[np.ndarray, "clips horizon action_dim"] = field(default_factory=lambda: np.zeros((0, 0, 0)))
    true: LatentSums = field(default_factory=LatentSums)
    copies: LatentSums = field(default_factory=LatentSums)  # of frame 0
    ids: list[str] = field(default_factory=list)
    firsts: list[int] = field(default_factory=list)
    starts: list[RolloutStart] = field(default_factory=list)
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
    names, space = [contender.name for contender in contenders], about.space
    seen, actions = _Seen({name: [] for name in names}, {name: LatentSums() for name in names}), []
    probed = set(spread(clips.count, probes.sensitivity_clips)) if probes.sensitivity_clips else set()
    plans = probes.planning_clips if space.position is not None else 0
    planned = set(spread(clips.count, plans)) if plans else set()

    def add(ids: Sequence[str], name: str, way: Way, mode: Mode, predicted: torch.Tensor) -> None:
        if (way, mode) == ("true", "rollout"):
            seen.predicted[name].add(predicted, ids)
        elif (way, mode, name) == ("persistence", "rollout", names[0]):  # copies are the same for all models
            seen.copies.add(predicted, ids)

    for batch, others in with_other_actions(batch for batch, _ in clips.read(None)):
        seen.true.add(batch.latents[:, 1:], batch.episode_ids)
        for contender in contenders:
            watch = partial(add, batch.episode_ids, contender.name)
            with contender.switched():
                seen.errors[contender.name].append(measured(contender.model, batch, ALL, metrics, others, watch))
        for row, clip in enumerate(range(len(seen.ids), len(seen.ids) + len(batch.starts))):
            if clip in probed:
                largest = int(batch.actions[row][:, space.sized].norm(dim=-1).argmax())
                seen.starts.append(start_of(batch, row, largest, clip))
                seen.moves += moves_of(batch, row, clip, space, probes.reach_cm / 100)
            if clip in planned:
                seen.planned.append(planning_start(batch, row, clip, about.seed))
        actions.append(batch.actions.cpu().numpy().astype(np.float64))
        seen.ids += batch.episode_ids
        seen.firsts += batch.starts
        progress(len(seen.ids), clips.count)
    seen.actions = np.concatenate(actions)
    return seen


def _measure(
    contender: Contender,
    seen: _Seen,
    clips: Clips,
    probes: ProbeOptions,
    about: About,
    reporter: Reporter,
) -> ModelResult:
    """Measure one model beyond its predictions: what is asked for, and applies."""
    name, model, starts, space = contender.name, contender.model, seen.starts, about.space
    found = ModelResult(
        name, contender.role, joined(seen.errors[name]), distribution=distribution_of(seen.predicted[name], seen.true)
    )

    def progress(what: str) -> Progress:
        return reporter.task(f"{what}, {name}")

    if starts:
        count, steps, width = seen.actions.shape
        actions, ids = seen.actions.reshape(count * steps, width), [one for one in seen.ids for _ in range(steps)]
        pool = ActionPool(actions, ids, space, probes.reach_cm / 100, probes.samples, about.seed)
        task = progress("other actions")
        sensitivity = measure_sensitivity(model, starts, pool, at_once=probes.at_once, progress=task)
        task = progress("action ranking")
        ranking = rank_actions(model, seen.moves, space, probes, seed=about.seed, progress=task)
        found = replace(found, sensitivity=sensitivity, ranking=ranking)
    moving = [start for start in starts if clips.moving[start.clip].any()] or starts
    if moving and probes.landscape_clips and seen.actions.shape[-1] >= 3:
        chosen = [moving[place] for place in spread(len(moving), probes.landscape_clips)]
        maps = measure_landscapes(model, chosen, space, probes, progress("energy landscapes"))
        found = replace(found, landscapes=maps)
    if seen.planned:
        planner = model if contender.to_plan is None else contender.to_plan()
        found = replace(found, plans=measure_plans(planner, seen.planned, probes.planning, progress("planning")))
    if probes.find_axes is not None and starts and probes.axis_clips and space.is_pose:
        chosen = [starts[place] for place in spread(len(starts), probes.axis_clips)]
        found = replace(found, beside={"axes": probes.find_axes(model, chosen, probes.at_once, progress("axes"))})
    return found


@torch.no_grad()
def _examples(
    contenders: Sequence[Contender], clips: RepeatableClips, evaluation: Evaluation, count: int
) -> tuple[Example, ...]:
    """Read the clips of the examples again: which ones these are is known only now."""
    known = evaluation.clips
    chosen = chosen_clips(evaluation.errors, known.action_size.sum(axis=1), count)
    if not chosen:
        return ()
    reasons = {(known.episode_ids[clip], known.starts[clip]): why for clip, why in chosen.items()}
    found = {}
    for batch, frames_of_row in clips.read(list(reasons)):
        for row, name in enumerate(zip(batch.episode_ids, batch.starts, strict=True)):
            predicted = {}
            for contender in contenders:
                with contender.switched():
                    predicted[contender.name] = prediction(contender.model, batch.clip(row))[0].float().cpu()
            found[name] = make_example(reasons[name], batch, row, predicted, frames_of_row(row))
    return tuple(found[name] for name in reasons if name in found)
