"""Measure several models on the same held-out clips: the trained model, its base model, and any other models."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.data.windows import spread_indices
from vjepa2_ac.distributed import gather_shared
from vjepa2_ac.episode import LatentBatch, Progress
from vjepa2_ac.evaluation.action_use import (
    Transition,
    gather_transitions,
    make_transition,
    measure_landscapes,
    rank_actions,
    select_moves,
)
from vjepa2_ac.evaluation.distribution import LatentSums, compare_distributions, frechet_distance_of_halves
from vjepa2_ac.evaluation.measure import (
    VALIDATION_PREDICTIONS,
    Predictor,
    concatenate_errors,
    measure_errors,
    no_readable_clips,
    predict_frames,
    with_shuffled_actions,
)
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import (
    L1,
    PERSISTENCE,
    About,
    ActionMode,
    Clips,
    Evaluation,
    Example,
    Metric,
    Mode,
    ModelResult,
    PredictionErrors,
    Role,
    registered_metrics,
)
from vjepa2_ac.model.distances import absolute_difference
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.spaces import POSE_CHANGE, ActionSpace, matrices_from_euler

_CPU = torch.device("cpu")
ClipName = tuple[str, int]  # id of the episode, first control step
FramesOfRow = Callable[[int], UInt8[np.ndarray, "time height width 3"] | None]  # row of the current batch -> frames


@dataclass(frozen=True)
class EvaluatedModel:
    """A model to measure, with its name and its role in the evaluation."""

    name: str
    role: Role
    model: Predictor
    # Returns the context in which the model predicts; for models that share weights, it selects the model's weights.
    prediction_context: Callable[[], contextlib.AbstractContextManager[object]] = contextlib.nullcontext


@dataclass(frozen=True)
class RepeatableClips:
    """Clips that can be read repeatedly, as batches of latents with their frames."""

    names: Sequence[ClipName]  # all clips
    # Reads the clips with these names, as batches; None: all clips of this process.
    read: Callable[[Sequence[ClipName] | None], Iterable[tuple[LatentBatch, FramesOfRow]]]
    space: ActionSpace = POSE_CHANGE  # meaning of the actions
    has_frames: bool = True  # False for cached latents, which have small frames only
    before: Float[Tensor, "1 time action_dim"] | None = None  # see `with_shuffled_actions`
    device: torch.device = _CPU  # device of the latents


def evaluate(
    evaluated_models: Sequence[EvaluatedModel],
    clips: RepeatableClips,
    about: About,
    *,
    metrics: tuple[Metric, ...] | None = None,
    probes: ProbeOptions | None = None,
    reporter: Reporter = SILENT,
) -> Evaluation:
    """Measure models on the same clips.

    Args:
        evaluated_models: The models, in the order of the table; one of them has the role "trained".
        clips: One or more clips.
        about: Description of the evaluation.
        metrics: Metrics of the errors, L1 first; None: all registered metrics.
        probes: Options of action ranking, energy landscapes and examples; None: the defaults.
        reporter: Shows the progress of each part of the work.
    """
    probes, metrics = probes or ProbeOptions(), metrics or registered_metrics()
    collected = _collect(evaluated_models, clips, probes, metrics, reporter.task("measuring"))
    actions, transitions = collected.actions, collected.transitions
    clips_info = describe_clips(actions, collected.names, space=clips.space, seconds_per_step=about.seconds_per_step)
    is_moving = {name: bool(steps.any()) for name, steps in zip(collected.names, clips_info.moving, strict=True)}
    moving = [each for each in transitions if is_moving[each.episode_id, each.first_step]] or transitions
    landscape_transitions = [moving[index] for index in spread_indices(len(moving), probes.landscape_clips)]
    action_dim = actions.shape[-1]
    models: dict[str, ModelResult] = {}
    for evaluated_model in evaluated_models:
        model, name = evaluated_model.model, evaluated_model.name
        ranking, landscapes = None, None
        with evaluated_model.prediction_context():
            if transitions:
                task = reporter.task(f"action ranking, {name}")
                ranking = rank_actions(model, collected.moves, clips.space, probes, seed=about.seed, progress=task)
            if landscape_transitions and action_dim >= 3:
                task = reporter.task(f"energy landscapes, {name}")
                landscapes = measure_landscapes(model, landscape_transitions, clips.space, probes, task)
        distribution = compare_distributions(collected.predicted[name], collected.true)
        errors = concatenate_errors(collected.errors[name])
        models[name] = ModelResult(name, evaluated_model.role, errors, landscapes, ranking, distribution)
    errors = next(result.errors for result in models.values() if result.role == "trained")
    note = f"No energy landscapes: they need actions of at least three numbers, and an action has {action_dim} numbers."
    return Evaluation(
        about=about,
        clips=clips_info,
        models=models,
        examples=_examples(evaluated_models, clips, clips_info, errors, probes.examples),
        notes=(note,) if landscape_transitions and action_dim < 3 else (),
        metrics=metrics,
        copies=compare_distributions(collected.copies, collected.true),
        fvd_of_halves=frechet_distance_of_halves(collected.true),
    )


@dataclass(frozen=True)
class _Collected:
    """Errors, actions, sums of latents, and transitions, collected over the clips of all processes."""

    errors: dict[str, list[PredictionErrors]]  # by model
    predicted: dict[str, LatentSums]  # rollouts with the true actions, by model
    true: LatentSums
    copies: LatentSums  # copies of frame 0 (persistence)
    actions: Float[np.ndarray, "clips horizon action_dim"]
    names: list[ClipName]
    transitions: list[Transition]  # the step with the largest action of each clip for action ranking
    moves: list[Transition]  # the moves of the same clips


def _collect(
    evaluated_models: Sequence[EvaluatedModel],
    clips: RepeatableClips,
    probes: ProbeOptions,
    metrics: Sequence[Metric],
    progress: Progress,
) -> _Collected:
    batches = with_shuffled_actions((batch for batch, _ in clips.read(None)), clips.before)
    first_batch = list(itertools.islice(batches, 1))  # empty if this process has no clips
    origins = [batch.latents[:, 1:].float().flatten(2).mean(dim=0).cpu() for batch, _ in first_batch]
    if not (origins := gather_shared(origins)):
        raise no_readable_clips()
    predicted = {model.name: LatentSums(origins[0]) for model in evaluated_models}
    errors: dict[str, list[PredictionErrors]] = {model.name: [] for model in evaluated_models}
    true, copies = LatentSums(origins[0]), LatentSums(origins[0])
    actions, names = list[np.ndarray](), list[ClipName]()
    transitions, moves = list[Transition](), list[Transition]()
    ranking_clips = {clips.names[index] for index in spread_indices(len(clips.names), probes.ranking_clips)}

    def add_rollout(ids: Sequence[str], name: str, actions: ActionMode, mode: Mode, latents: torch.Tensor) -> None:
        if (actions, mode) == ("true", "rollout"):
            predicted[name].add(latents, ids)

    for batch, shuffled_actions in itertools.chain(first_batch, batches):
        true.add(batch.latents[:, 1:], batch.episode_ids)
        copies.add(batch.latents[:, :1].expand_as(batch.latents[:, 1:]), batch.episode_ids)
        for evaluated_model in evaluated_models:
            on_prediction = partial(add_rollout, batch.episode_ids, evaluated_model.name)
            with evaluated_model.prediction_context():
                errors[evaluated_model.name].append(
                    measure_errors(
                        evaluated_model.model, batch, VALIDATION_PREDICTIONS, metrics, shuffled_actions, on_prediction
                    )
                )
        for row, name in enumerate(zip(batch.episode_ids, batch.starts, strict=True)):
            names.append(name)
            if name in ranking_clips:
                largest_step = int(batch.actions[row][:, clips.space.size_axes].norm(dim=-1).argmax())
                transitions.append(make_transition(batch, row, largest_step))
                moves += select_moves(batch, row, clips.space, probes.reach_cm / 100)
        actions.append(batch.actions.cpu().numpy().astype(np.float64))
        progress(len(names), len(clips.names))
    names = gather_shared(names)
    return _Collected(
        errors={name: gather_shared(parts) for name, parts in errors.items()},
        predicted={name: LatentSums.join(gather_shared([sums])) for name, sums in predicted.items()},
        true=LatentSums.join(gather_shared([true])),
        copies=LatentSums.join(gather_shared([copies])),
        actions=np.concatenate(gather_shared(actions)),
        names=names,
        transitions=gather_transitions(transitions, clips.device),
        moves=gather_transitions(moves, clips.device),
    )


@torch.no_grad()
def _examples(
    evaluated_models: Sequence[EvaluatedModel],
    clips: RepeatableClips,
    clips_info: Clips,
    errors: PredictionErrors,
    max_examples: int,
) -> tuple[Example, ...]:
    """Choose the example clips by their errors, and read them again with their frames."""
    chosen = select_example_clips(errors, clips_info.action_size.sum(axis=1), max_examples)
    if not chosen:
        return ()
    reasons = {(clips_info.episode_ids[clip], clips_info.starts[clip]): why for clip, why in chosen.items()}
    examples = {}
    for batch, frames_of_row in clips.read(list(reasons)):
        for row, name in enumerate(zip(batch.episode_ids, batch.starts, strict=True)):
            true = batch.latents[row].float().cpu()
            predicted = {PERSISTENCE: true[:1]}
            for evaluated_model in evaluated_models:
                with evaluated_model.prediction_context():
                    predicted[evaluated_model.name] = (
                        predict_frames(evaluated_model.model, batch.select_clip(row))[0].float().cpu()
                    )
            patch_errors = {
                source: rearrange(
                    absolute_difference(latents, true[1:]).mean(dim=-1),
                    "horizon (h w) -> horizon h w",
                    h=math.isqrt(true.shape[1]),
                ).numpy()
                for source, latents in predicted.items()
            }
            examples[name] = Example(reasons[name], *name, frames_of_row(row), patch_errors)
    return tuple(examples[name] for name in reasons if name in examples)


# ---- the clips ----

# A step with a change of the pose is idle if the speed of the flange, its angular speed and the change of the gripper's
# gripper position are all below these limits.
SPEED_CM_S = 2.0
TURN_DEGREES_S = 10.0
GRIP = 0.05  # in a model step
_IDLE_SHARE = 0.1  # a vector is idle if its norm is below this fraction of the 95th percentile of all norms


def describe_clips(
    actions: Float[np.ndarray, "clips horizon action_dim"],
    names: Sequence[ClipName],
    *,
    space: ActionSpace,
    seconds_per_step: float,
) -> Clips:
    """Return the clips with the size of the action at each step, and whether the robot moves in it.

    Args:
        actions: The actions of all clips.
        names: Name of each clip.
        space: Meaning of the actions.
        seconds_per_step: Duration of a model step.
    """
    size, (episode_ids, starts) = space.compute_display_size(actions), zip(*names, strict=True)
    if space.position is None or space.rotation is None or space.gripper is None:
        min_norm = _IDLE_SHARE * float(np.percentile(size, 95))
        rule = f"the norm of the action is {min_norm:.3g} or more, a tenth of the 95th percentile of all norms"
        return Clips(episode_ids, starts, size, size >= max(min_norm, np.finfo(float).tiny), rule)
    is_translating = size >= SPEED_CM_S * seconds_per_step
    traces = np.trace(matrices_from_euler(actions[..., space.rotation]), axis1=-2, axis2=-1)
    angles_degrees = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0)))
    is_rotating = angles_degrees >= TURN_DEGREES_S * seconds_per_step
    is_gripping = np.abs(actions[..., space.gripper]) >= GRIP
    rule = (
        f"the flange moves at {SPEED_CM_S:g} cm/s or more, or turns at {TURN_DEGREES_S:g} degrees/s or more, or the"
        f" gripper opens or closes by {GRIP:.0%} or more in the step"
    )
    return Clips(episode_ids, starts, size, is_translating | is_rotating | is_gripping, rule)


def select_example_clips(
    errors: PredictionErrors, distances: Float[np.ndarray, " clips"], max_clips: int
) -> dict[int, str]:
    """Return the indices of the clips to show, each with the reason: most motion, or best, worst or median error.

    The errors are relative to persistence.

    Args:
        errors: Errors of the trained model.
        distances: Distance that the robot moves in each clip.
        max_clips: Maximum number of clips.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        trained, persistence = (errors.of("rollout", L1, actions).mean(axis=1) for actions in ("true", "persistence"))
        ratios = trained / persistence
    order = np.argsort(np.nan_to_num(ratios, nan=np.inf, posinf=np.inf), kind="stable")
    clips_by_reason = {
        "most motion": int(np.argmax(distances)),
        "best": int(order[0]),
        "worst": int(order[-1]),
        "median": int(order[len(order) // 2]),
    }
    chosen: dict[int, str] = {}
    for why, clip in clips_by_reason.items():
        chosen[clip] = f"{chosen[clip]}, {why}" if clip in chosen else why
    return dict(list(chosen.items())[:max_clips])
