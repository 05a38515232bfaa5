"""Prediction metrics: errors between predicted and true latents, beside the error of persistence.

All errors compare layer-normalised latents, per clip and model step. *Persistence* is the error of copying a frame that
was seen. A ratio of 1 means: as good as doing nothing; 0: perfect.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import cosine_similarity

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.intervals import Estimate, ratio
from vjepa2_ac.evaluation.result import Errors, Predicted


@runtime_checkable
class Predictor(Protocol):
    """A predictor of latents: `WorldModel`, or an oracle in a test."""

    def predict(
        self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None
    ) -> Float[Tensor, "batch time tokens dim"]:
        """Return the prediction of each next frame from the true frames before it."""
        ...

    def rollout(
        self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None
    ) -> Float[Tensor, "batch horizon tokens dim"]:
        """Return the frames after the context, each prediction fed back."""
        ...


@torch.no_grad()
def measured(model: Predictor, batch: LatentBatch, actions: Float[Tensor, "batch time action_dim"]) -> Predicted:
    """Return the errors of a model on a batch of clips, with their own or other actions; states are the true ones."""
    latents, states = batch.latents, batch.states[:, :-1]
    extrinsics = None if batch.extrinsics is None else batch.extrinsics[:, :-1]
    truth = latents[:, 1:]
    return Predicted(
        teacher_forced=distances(model.predict(latents[:, :-1], actions, states, extrinsics), truth),
        rollout=distances(model.rollout(latents[:, :1], actions, states, extrinsics), truth),
    )


@torch.no_grad()
def persistence_of(batch: LatentBatch) -> Predicted:
    """Return the errors of doing nothing: copying the frame before (teacher forced), or the first one (rollout)."""
    latents, truth = batch.latents, batch.latents[:, 1:]
    return Predicted(
        teacher_forced=distances(latents[:, :-1], truth), rollout=distances(latents[:, :1].expand_as(truth), truth)
    )


def distances(
    predicted: Float[Tensor, "batch time tokens dim"], true: Float[Tensor, "batch time tokens dim"]
) -> Errors:
    """Return the error of predictions in each metric of `evaluation.result`, computed in float32."""
    predicted, true = predicted.float(), true.float()
    difference = predicted - true
    similarity = cosine_similarity(predicted, true, dim=-1)
    return Errors(
        l1=_plain(difference.abs().mean(dim=(2, 3))),
        l2=_plain(difference.square().mean(dim=(2, 3))),
        cosine=_plain((1 - similarity).clamp(min=0).mean(dim=2)),
    )


def with_other_actions(
    batches: Iterable[LatentBatch],
) -> Iterator[tuple[LatentBatch, Float[Tensor, "batch time action_dim"]]]:
    """Yield each batch with other actions for its clips: those of the clip before, whatever the batch size.

    The first clip gets those of the second; if it is alone, its own reversed.
    """
    rest = iter(batches)
    head = [batch for _, batch in zip(range(1), rest, strict=False)]
    if head and len(head[0].actions) == 1:
        head += [batch for _, batch in zip(range(1), rest, strict=False)]
    first_ones = [batch.actions for batch in head]
    before = None
    for batch in chain(head, rest):
        if before is None:
            known = torch.cat(first_ones)
            before = known[1:2] if len(known) > 1 else known.flip(1)
        yield batch, torch.cat([before, batch.actions[:-1]])
        before = batch.actions[-1:]


@dataclass(frozen=True)
class PredictionErrors:
    """L1 errors of one model on a set of clips, as a validation measures them; row i of every array is clip i."""

    rollout: Float[np.ndarray, "clips horizon"]  # open loop from the first frame
    persistence: Float[np.ndarray, "clips horizon"]  # copying the first frame
    one_step: Float[np.ndarray, " clips"]  # teacher-forced, mean over the clip's steps
    one_step_zero_actions: Float[np.ndarray, " clips"]
    one_step_shuffled_actions: Float[np.ndarray, " clips"]  # the actions of the clip before
    one_step_persistence: Float[np.ndarray, " clips"]  # copying the frame before
    episode_ids: tuple[str, ...]


@torch.no_grad()
def prediction_errors(model: Predictor, batches: Iterable[LatentBatch]) -> PredictionErrors:
    """Measure a model on clips of held-out episodes, batch after batch, so that no latents are stored.

    Raises:
        ValueError: No clips.
    """
    parts: list[dict[str, np.ndarray]] = []
    episode_ids: list[str] = []
    for batch, others in with_other_actions(batches):
        parts.append(_batch_errors(model, batch, others))
        episode_ids += batch.episode_ids
    if not parts:
        raise ValueError("no clips to measure on")
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return PredictionErrors(**joined, episode_ids=tuple(episode_ids))


@torch.no_grad()
def one_step_errors(
    model: Predictor, batch: LatentBatch, actions: Float[Tensor, "batch steps action_dim"] | None = None
) -> tuple[Float[np.ndarray, " batch"], Float[np.ndarray, " batch"]]:
    """Return, for each clip, the teacher-forced L1 error with its own or other actions, and that of persistence."""
    latents, extrinsics = batch.latents, batch.extrinsics
    given = batch.actions if actions is None else actions
    before = None if extrinsics is None else extrinsics[:, :-1]
    predicted = model.predict(latents[:, :-1], given, batch.states[:, :-1], before)
    truth = latents[:, 1:]
    return _error(predicted, truth).mean(axis=1), _error(latents[:, :-1], truth).mean(axis=1)


def ratios_by_horizon(errors: PredictionErrors) -> list[Estimate]:
    """Return the open-loop error over persistence at horizon 1, 2, ... model steps."""
    horizons = range(errors.rollout.shape[1])
    return [ratio(errors.rollout[:, h], errors.persistence[:, h], errors.episode_ids) for h in horizons]


def one_step_ratios(errors: PredictionErrors) -> dict[str, Estimate]:
    """Return the teacher-forced error over persistence with the true, zero and shuffled actions.

    A model that uses its actions is much better with the true ones than with the others.
    """
    by_actions = {
        "true": errors.one_step,
        "zero": errors.one_step_zero_actions,
        "shuffled": errors.one_step_shuffled_actions,
    }
    return {name: ratio(e, errors.one_step_persistence, errors.episode_ids) for name, e in by_actions.items()}


def _batch_errors(model: Predictor, batch: LatentBatch, other_actions: Tensor) -> dict[str, np.ndarray]:
    latents, actions = batch.latents, batch.actions
    states = batch.states[:, :-1]
    extrinsics = None if batch.extrinsics is None else batch.extrinsics[:, :-1]
    truth = latents[:, 1:]
    one_step, one_step_persistence = one_step_errors(model, batch)
    return {
        "rollout": _error(model.rollout(latents[:, :1], actions, states, extrinsics), truth),
        "persistence": _error(latents[:, :1].expand_as(truth), truth),
        "one_step": one_step,
        "one_step_zero_actions": one_step_errors(model, batch, torch.zeros_like(actions))[0],
        "one_step_shuffled_actions": one_step_errors(model, batch, other_actions)[0],
        "one_step_persistence": one_step_persistence,
    }


def _error(predicted: Tensor, true: Tensor) -> Float[np.ndarray, "batch time"]:
    """Mean absolute difference over tokens and dim."""
    return _plain((predicted.float() - true.float()).abs().mean(dim=(2, 3)))


def _plain(values: Tensor) -> Float[np.ndarray, "batch time"]:
    return np.asarray(values.cpu().numpy(), dtype=np.float64)
