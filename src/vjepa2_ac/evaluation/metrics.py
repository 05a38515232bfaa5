"""How far are predicted latents from the true ones, and how does that compare with doing nothing?

Every error is a mean absolute difference of layer-normalised latents, per clip. Beside it stands *persistence*: the
error of copying the last frame that was seen. A ratio of 1 means: as good as doing nothing; 0: perfect.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.episode import LatentBatch


@runtime_checkable
class Predictor(Protocol):
    """What is measured: something that predicts latents. `WorldModel` is one; so is an oracle in a test."""

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


@dataclass(frozen=True)
class PredictionErrors:
    """Errors of one model on a set of clips; row i of every array is clip i."""

    rollout: Float[np.ndarray, "clips horizon"]  # open loop from the first frame
    persistence: Float[np.ndarray, "clips horizon"]  # copying the first frame
    one_step: Float[np.ndarray, " clips"]  # teacher-forced, mean over the clip's steps
    one_step_zero_actions: Float[np.ndarray, " clips"]
    one_step_shuffled_actions: Float[np.ndarray, " clips"]  # the actions of the clip before
    one_step_persistence: Float[np.ndarray, " clips"]  # copying the frame before
    episode_ids: tuple[str, ...]


@dataclass(frozen=True)
class Ratio:
    """An error over another, with a 95 % bootstrap interval over episodes; NaN where there is one episode only."""

    value: float
    low: float
    high: float

    @property
    def has_interval(self) -> bool:
        """Whether there were episodes enough to say how sure the value is."""
        return not math.isnan(self.low)

    def as_dict(self) -> dict[str, float | None]:
        """Return plain values, for JSON; None where there is no interval."""
        return {
            "value": self.value,
            "low": self.low if self.has_interval else None,
            "high": self.high if self.has_interval else None,
        }

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]" if self.has_interval else f"{self.value:.3f}"


class ErrorMeter:
    """Collects the errors of one model, batch after batch, so that no latents need be kept."""

    def __init__(self) -> None:
        self._parts: list[dict[str, np.ndarray]] = []
        self._episode_ids: list[str] = []
        self._last_actions: Tensor | None = None

    @torch.no_grad()
    def add(self, model: Predictor, batch: LatentBatch) -> None:
        """Measure a model on one batch of clips."""
        before = _stand_in(batch.actions) if self._last_actions is None else self._last_actions
        self._parts.append(_batch_errors(model, batch, torch.cat([before, batch.actions[:-1]])))
        self._last_actions = batch.actions[-1:]
        self._episode_ids += batch.episode_ids

    def result(self) -> PredictionErrors:
        """Return the errors of every clip seen.

        Raises:
            ValueError: No clips.
        """
        if not self._parts:
            raise ValueError("no clips to measure on")
        joined = {key: np.concatenate([part[key] for part in self._parts]) for key in self._parts[0]}
        return PredictionErrors(**joined, episode_ids=tuple(self._episode_ids))


def prediction_errors(model: Predictor, batches: Iterable[LatentBatch]) -> PredictionErrors:
    """Measure a model on clips of held-out episodes.

    Raises:
        ValueError: No clips.
    """
    meter = ErrorMeter()
    for batch in batches:
        meter.add(model, batch)
    return meter.result()


def _stand_in(actions: Tensor) -> Tensor:
    """Return other actions for the very first clip: those of the second, or its own backwards if it is alone."""
    return actions[1:2] if len(actions) > 1 else actions.flip(1)


@torch.no_grad()
def one_step_errors(
    model: Predictor, batch: LatentBatch, actions: Float[Tensor, "batch steps action_dim"] | None = None
) -> tuple[Float[np.ndarray, " batch"], Float[np.ndarray, " batch"]]:
    """Return, for each clip, the teacher-forced error with its own or other actions, and that of persistence."""
    latents, extrinsics = batch.latents, batch.extrinsics
    tried = batch.actions if actions is None else actions
    before = None if extrinsics is None else extrinsics[:, :-1]
    predicted = model.predict(latents[:, :-1], tried, batch.states[:, :-1], before)
    truth = latents[:, 1:]
    return _error(predicted, truth).mean(axis=1), _error(latents[:, :-1], truth).mean(axis=1)


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
    difference = (predicted.float() - true.float()).abs().mean(dim=(2, 3))
    return np.asarray(difference.cpu().numpy(), dtype=np.float64)


def ratio(
    errors: Float[np.ndarray, " clips"],
    persistence: Float[np.ndarray, " clips"],
    episode_ids: tuple[str, ...],
    *,
    resamples: int = 2000,
    seed: int = 0,
) -> Ratio:
    """Return mean error over mean persistence, with a percentile bootstrap that draws whole episodes.

    Clips of one episode resemble each other; drawing clips would make the interval too narrow.
    """
    return _bootstrapped(lambda sums: sums[0] / sums[1], (errors, persistence), episode_ids, resamples, seed)


def ratio_difference(
    one: tuple[Float[np.ndarray, " clips"], Float[np.ndarray, " clips"]],
    other: tuple[Float[np.ndarray, " clips"], Float[np.ndarray, " clips"]],
    episode_ids: tuple[str, ...],
    *,
    resamples: int = 2000,
    seed: int = 0,
) -> Ratio:
    """Return the `ratio` of one pair of (errors, persistence) minus that of another on the same clips, with interval.

    Both are drawn together, so what makes an episode hard for both does not widen the interval.
    """
    return _bootstrapped(
        lambda sums: sums[0] / sums[1] - sums[2] / sums[3], (*one, *other), episode_ids, resamples, seed
    )


def _bootstrapped(
    of_sums: Callable[[np.ndarray], np.ndarray],
    columns: tuple[np.ndarray, ...],
    episode_ids: tuple[str, ...],
    resamples: int,
    seed: int,
) -> Ratio:
    value = float(of_sums(np.stack([column.sum() for column in columns])))
    names, episode_of = np.unique(np.array(episode_ids), return_inverse=True)
    if len(names) < 2:
        return Ratio(value, math.nan, math.nan)
    sums = np.stack([np.bincount(episode_of, weights=column) for column in columns])
    drawn = np.random.default_rng(seed).integers(sums.shape[1], size=(resamples, sums.shape[1]))
    low, high = np.percentile(of_sums(sums[:, drawn].sum(axis=2)), [2.5, 97.5])
    return Ratio(value, float(low), float(high))


def ratios_by_horizon(errors: PredictionErrors) -> list[Ratio]:
    """Return the open-loop error over persistence at horizon 1, 2, ... model steps."""
    horizons = range(errors.rollout.shape[1])
    return [ratio(errors.rollout[:, h], errors.persistence[:, h], errors.episode_ids) for h in horizons]


def one_step_ratios(errors: PredictionErrors) -> dict[str, Ratio]:
    """Return the teacher-forced error over persistence with the true, zero and shuffled actions.

    A model that uses its actions is much better with the true ones than with the other two.
    """
    tried = {
        "true": errors.one_step,
        "zero": errors.one_step_zero_actions,
        "shuffled": errors.one_step_shuffled_actions,
    }
    return {name: ratio(e, errors.one_step_persistence, errors.episode_ids) for name, e in tried.items()}
