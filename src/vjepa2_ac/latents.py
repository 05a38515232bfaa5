"""Pixels to latents: where is the frozen encoder run?

Training, evaluation and planning see only what comes out of here.
"""

from __future__ import annotations

import torch
from jaxtyping import Float32
from torch import Tensor

from vjepa2_ac.data.transforms import pixels_to_input
from vjepa2_ac.episode import Batch, LatentBatch, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.heads import widths_of_model
from vjepa2_ac.model.world_model import WorldModel


@torch.no_grad()
def encode_batch(world_model: WorldModel, batch: Batch, *, device: torch.device, chunk: int) -> LatentBatch:
    """Encode the frames of a batch, each by itself, on the device; a training batch is augmented there, too.

    Args:
        world_model: The model whose frozen encoder is used.
        batch: Clips as the loader gives them: uint8 pixels, cropped, of any size.
        device: Where the model is.
        chunk: Frames that go through the encoder at once.

    Raises:
        InputError: The model wants camera poses and a clip has none.
    """
    extrinsics = extrinsics_for(world_model, batch)
    frames = batch.frames.to(device, non_blocking=True)
    inputs = pixels_to_input(frames, world_model.image_size, batch.augmentations)
    return LatentBatch(
        latents=world_model.encode(inputs, chunk=chunk),
        states=batch.states.to(device, non_blocking=True),
        actions=batch.actions.to(device, non_blocking=True),
        extrinsics=None if extrinsics is None else extrinsics.to(device, non_blocking=True),
        episode_ids=batch.episode_ids,
        starts=batch.starts,
    )


def require_widths(world_model: WorldModel, widths: Widths, *, where: str) -> None:
    """Refuse data whose states or actions are wider or narrower than what the model takes.

    Args:
        world_model: The model.
        widths: Of the data.
        where: What named the model.

    Raises:
        InputError: Names both.
    """
    needed = widths_of_model(world_model.sizes)
    if widths != needed:
        raise InputError(
            where=where,
            found=f"data with states of {widths.state} and actions of {widths.action} numbers",
            needed=f"{needed.state} and {needed.action}, which this model takes",
            fix="Choose other data, or train on these: `train` then replaces the model's input heads",
        )


def extrinsics_for(world_model: WorldModel, batch: Batch) -> Float32[Tensor, "batch time 6"] | None:
    """Return the camera poses of a batch if the model wants them.

    Raises:
        InputError: It does, and a clip has none; names the episodes of the batch.
    """
    if not world_model.sizes.predictor.use_extrinsics:
        return None
    if batch.extrinsics is None:
        raise InputError(
            where="model: predictor.use_extrinsics",
            found=f"no pose of the camera in some of these episodes: {', '.join(dict.fromkeys(batch.episode_ids))}",
            needed="one at every step of every episode",
            fix="Choose a data.source and data.camera that have them, or a model without use_extrinsics",
        )
    return batch.extrinsics
