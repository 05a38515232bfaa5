"""Did training help? The base and what was trained, side by side on held-out episodes."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.data.transforms import pixels_to_input
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.evaluation.metrics import ErrorMeter, PredictionErrors
from vjepa2_ac.latents import encode_batch
from vjepa2_ac.model.adapter_end import base_only
from vjepa2_ac.model.world_model import WorldModel

Variant = Callable[[WorldModel], contextlib.AbstractContextManager[object]]


_NO_BASE = "There is no base to compare with: it takes states or actions of other widths than this robot's."


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
    why_no_base: str = ""  # where there would be a base, but not one to compare with

    @property
    def trained(self) -> str:
        """The name of what was trained: adapter, or model."""
        return list(self.models)[-1]

    @property
    def horizon(self) -> int:
        """How many model steps ahead was measured."""
        return int(self.models[self.trained].rollout.shape[1])

    @property
    def episodes(self) -> int:
        """How many episodes the clips come from."""
        return len(set(self.models[self.trained].episode_ids))

    @property
    def clips(self) -> int:
        """How many clips were measured."""
        return len(self.models[self.trained].episode_ids)


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

    A base whose input heads were replaced cannot predict on these clips: it is left out, and the result says why.

    Raises:
        ValueError: No clips.
    """
    world_model.eval()
    why_no_base = _NO_BASE if has_base and world_model.fresh_heads is not None else ""
    variants: dict[str, Variant] = {"base": base_only} if has_base and not why_no_base else {}
    variants["adapter" if _has_lora(world_model) else "model"] = contextlib.nullcontext
    meters = {name: ErrorMeter() for name in variants}
    chosen: tuple[Batch, LatentBatch, int] | None = None
    most_motion = -1.0
    for batch in batches:
        latents = encode_batch(world_model, batch, device=device, chunk=encode_chunk)
        for name, variant in variants.items():
            with variant(world_model):
                meters[name].add(world_model, latents)
        motion = (latents.latents[:, -1] - latents.latents[:, 0]).abs().mean(dim=(1, 2))
        if motion.max().item() > most_motion:
            most_motion = motion.max().item()
            chosen = batch, latents, int(motion.argmax())
    if chosen is None:
        raise ValueError("no clips to evaluate on")
    models = {name: meter.result() for name, meter in meters.items()}
    return Evaluation(models, seconds_per_step, _example(world_model, *chosen, variants), why_no_base)


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


def _has_lora(world_model: WorldModel) -> bool:
    return world_model.adaptation is not None and world_model.adaptation.kind == "lora"
