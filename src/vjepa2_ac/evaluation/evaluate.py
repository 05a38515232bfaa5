"""Did the adapter help? Base and adapter side by side on held-out episodes, and the answer in words."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.data.transforms import pixels_to_input
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.evaluation.metrics import (
    ErrorMeter,
    PredictionErrors,
    Ratio,
    one_step_ratios,
    ratio,
    ratios_by_horizon,
)
from vjepa2_ac.latents import encode_batch
from vjepa2_ac.model.lora import base_only
from vjepa2_ac.model.world_model import WorldModel

Variant = Callable[[WorldModel], contextlib.AbstractContextManager[object]]


@dataclass(frozen=True)
class Example:
    """One clip, frame by frame, and where the predictions of it are wrong."""

    frames: UInt8[np.ndarray, "time size size 3"]  # what the encoder saw
    errors: dict[str, Float[np.ndarray, "horizon grid grid"]]  # model -> mean absolute error of each patch
    episode_id: str


@dataclass(frozen=True)
class Evaluation:
    """What was measured on held-out episodes; models are in the order of the table."""

    models: dict[str, PredictionErrors]
    seconds_per_step: float
    example: Example

    @property
    def episodes(self) -> int:
        """How many episodes the clips come from."""
        return len(set(next(iter(self.models.values())).episode_ids))

    @property
    def clips(self) -> int:
        """How many clips were measured."""
        return len(next(iter(self.models.values())).episode_ids)


def evaluate(
    world_model: WorldModel,
    batches: Iterable[Batch],
    *,
    has_base: bool,
    device: torch.device,
    encode_chunk: int,
    seconds_per_step: float,
) -> Evaluation:
    """Measure a model on clips, with what was trained switched on and, where `has_base`, off.

    Raises:
        ValueError: No clips.
    """
    world_model.eval()
    variants: dict[str, Variant] = {"base": base_only} if has_base else {}
    variants["adapter" if has_base else "model"] = contextlib.nullcontext
    meters = {name: ErrorMeter() for name in variants}
    example: Example | None = None
    most_motion = -1.0
    for batch in batches:
        latents = encode_batch(world_model, batch, device=device, chunk=encode_chunk)
        for name, variant in variants.items():
            with variant(world_model):
                meters[name].add(world_model, latents)
        motion = (latents.latents[:, -1] - latents.latents[:, 0]).abs().mean(dim=(1, 2))
        if motion.max().item() > most_motion:
            most_motion = motion.max().item()
            example = _example(world_model, batch, latents, int(motion.argmax()), variants)
    if example is None:
        raise ValueError("no clips to evaluate on")
    models = {name: meter.result() for name, meter in meters.items()}
    return Evaluation(models=models, seconds_per_step=seconds_per_step, example=example)


@torch.no_grad()
def _example(
    world_model: WorldModel, batch: Batch, latents: LatentBatch, clip: int, variants: dict[str, Variant]
) -> Example:
    z, actions, states = (x[clip : clip + 1] for x in (latents.latents, latents.actions, latents.states))
    extrinsics = None if latents.extrinsics is None else latents.extrinsics[clip : clip + 1, :-1]
    grid = math.isqrt(world_model.num_tokens)

    def patch_errors(predicted: Tensor) -> np.ndarray:
        error = (predicted.float() - z[:, 1:].float()).abs().mean(dim=-1)
        return np.asarray(rearrange(error, "1 horizon (h w) -> horizon h w", h=grid).cpu().numpy())

    errors = {"persistence": patch_errors(z[:, :1].expand_as(z[:, 1:]))}
    for name, variant in variants.items():
        with variant(world_model):
            errors[name] = patch_errors(world_model.rollout(z[:, :1], actions, states[:, :-1], extrinsics))
    return Example(
        frames=_seen_by_the_encoder(batch.frames[clip], world_model.image_size),
        errors=errors,
        episode_id=latents.episode_ids[clip],
    )


def _seen_by_the_encoder(frames: Tensor, size: int) -> UInt8[np.ndarray, "time size size 3"]:
    inputs = pixels_to_input(frames[None], size)[0]
    low, high = inputs.amin(), inputs.amax()
    shown = (inputs - low) / (high - low).clamp(min=1e-6) * 255
    return np.asarray(rearrange(shown, "time c h w -> time h w c").round().to(torch.uint8).cpu().numpy())


def improvement(evaluation: Evaluation, horizon: int) -> Ratio | None:
    """Return by which share of the base's error the adapter's is smaller at a horizon (1 = first step), paired by clip.

    None if there is no base to compare with.
    """
    if "adapter" not in evaluation.models:
        return None
    base, adapter = evaluation.models["base"], evaluation.models["adapter"]
    kept = ratio(adapter.rollout[:, horizon - 1], base.rollout[:, horizon - 1], base.episode_ids)
    return Ratio(1 - kept.value, 1 - kept.high, 1 - kept.low)


def verdict(evaluation: Evaluation) -> str:
    """Say in words whether the adapter helped, at the farthest horizon."""
    where = f"on {evaluation.clips} clips of {evaluation.episodes} held-out episodes"
    models = evaluation.models
    error = ratios_by_horizon(models["adapter" if "adapter" in models else "model"])
    horizon = len(error)
    ahead = f"{horizon * evaluation.seconds_per_step:.1f} s ahead"
    absolute = f"Its error {ahead} is {error[-1].value:.2f} of doing nothing ({_interval(error[-1], '.2f')})"
    absolute += (
        ": better." if error[-1].high < 1 else ": NOT better." if error[-1].low > 1 else ": no clear difference."
    )
    gain = improvement(evaluation, horizon)
    if gain is None:
        return f"The model was measured {where}. {absolute}"
    compared = (
        f"{abs(gain.value):.0%} {'better' if gain.value > 0 else 'WORSE'} than the base ({_interval(gain, '.0%')})"
    )
    if gain.low <= 0 <= gain.high:
        return f"The adapter did not clearly help: it predicts {ahead} {compared}, {where}. {absolute}"
    return f"The adapter predicts {ahead} {compared}, {where}. {absolute}"


def _interval(value: Ratio, form: str) -> str:
    return f"95 % interval {value.low:{form}} to {value.high:{form}}"


def spread(evaluations: Sequence[Evaluation]) -> str:
    """Say how much runs that differ in their seed differ in their result, at the farthest horizon."""
    errors, gains = [], []
    for evaluation in evaluations:
        name = "adapter" if "adapter" in evaluation.models else "model"
        errors.append(ratios_by_horizon(evaluation.models[name])[-1].value)
        gain = improvement(evaluation, evaluation.models[name].rollout.shape[1])
        gains += [] if gain is None else [gain.value]
    words = f"{len(evaluations)} runs: error over persistence {_mean_and_range(errors, '.3f')}"
    return words + (f"; better than the base by {_mean_and_range(gains, '.1%')}" if gains else "")


def _mean_and_range(values: list[float], form: str) -> str:
    return f"{np.mean(values):{form}} ({min(values):{form}} to {max(values):{form}})"


def evaluation_as_dict(evaluation: Evaluation) -> dict[str, Any]:
    """Return every figure as plain values, for `evaluation.json`."""
    models = {
        name: {
            "rollout_over_persistence": [asdict(r) for r in ratios_by_horizon(errors)],
            "one_step_over_persistence": {k: asdict(r) for k, r in one_step_ratios(errors).items()},
            "rollout_error": errors.rollout.mean(axis=0).tolist(),
        }
        for name, errors in evaluation.models.items()
    }
    any_model = next(iter(evaluation.models.values()))
    horizons = any_model.rollout.shape[1]
    gains = [improvement(evaluation, h + 1) for h in range(horizons)]
    return {
        "verdict": verdict(evaluation),
        "clips": evaluation.clips,
        "episodes": evaluation.episodes,
        "seconds_per_step": evaluation.seconds_per_step,
        "persistence_error": any_model.persistence.mean(axis=0).tolist(),
        "models": models,
        "improvement_over_base": [asdict(g) for g in gains if g is not None],
    }
