"""Batches of latents: from the frozen encoder, or from a latent cache.

Training, evaluation and planning only see the result of this module.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.sources.latent_files import unpack_latents
from vjepa2_ac.data.sources.latents import Encoding, LatentSource, another_cache
from vjepa2_ac.data.transforms import Crop, pixels_to_input, split_views, view
from vjepa2_ac.episode import Batch, LatentBatch, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.encoder import ENCODE_CHUNK
from vjepa2_ac.model.world_model import WorldModel, heads_to_replace, widths_as_text


@torch.no_grad()
def encode_batch(
    world_model: WorldModel, batch: Batch, *, device: torch.device, chunk: int = ENCODE_CHUNK
) -> LatentBatch:
    """Encode the frames of a batch on the device, each independently.

    Latents of a batch from a cache are used unchanged: `require_same_encoder` has compared the encoders.

    Args:
        world_model: The model whose frozen encoder is used.
        batch: Clips from the loader: uint8 pixels, cropped, of any size; or latents.
        device: The model's device.
        chunk: Frames per encoder call.

    Raises:
        InputError: The model needs camera poses and a clip has none.
    """
    batch = batch.to(device, non_blocking=True)
    if batch.latents is not None:
        latents = unpack_latents(batch.latents)
    elif batch.frames is not None:
        latents = world_model.encode(pixels_to_input(batch.frames, world_model.image_size), chunk=chunk)
    else:
        raise ValueError("a batch with neither frames nor latents")
    return LatentBatch(
        latents=latents,
        states=batch.states,
        actions=batch.actions,
        extrinsics=extrinsics_for(world_model, batch),
        episode_ids=batch.episode_ids,
        starts=batch.starts,
    )


@torch.no_grad()
def encode_frames(
    world_model: WorldModel,
    frames: UInt8[np.ndarray, "time height all 3"],
    crop: Crop,
    *,
    chunk: int = ENCODE_CHUNK,
    views: int = 1,
) -> Float[Tensor, "time tokens dim"]:
    """Return the latents of camera frames, each encoded independently, on the model's device.

    Of several views side by side each is encoded by itself; their tokens follow one after another.

    Args:
        world_model: The model whose frozen encoder is used.
        frames: RGB, uncropped, of any size.
        crop: The part of a frame that the model sees.
        chunk: Frames per encoder call; no more are on the device as pixels at once.
        views: Cameras side by side in each frame.

    Raises:
        InputError: The width is not that of so many views.
    """

    def encoded(part: UInt8[np.ndarray, "frames height all 3"]) -> Tensor:
        seen = view(split_views(part, views), crop)
        pixels = torch.from_numpy(np.ascontiguousarray(seen)).to(world_model.device)[None]
        latents = world_model.encode(pixels_to_input(pixels, world_model.image_size), chunk=chunk)[0]
        return latents.reshape(len(part), -1, latents.shape[-1])

    return torch.cat([encoded(frames[first : first + chunk]) for first in range(0, len(frames), chunk)])


def encoding_of(world_model: WorldModel, config: Config) -> Encoding:
    """Return what determines the latents of a model in a run: the key by which a cache is found or refused.

    Takes as long as it takes to hash the encoder's weights.
    """
    parts = {
        "encoder": world_model.encoder_fingerprint(),
        "image_size": world_model.image_size,
        "patch_size": world_model.sizes.patch_size,
        "normalisation": 1,  # in `transforms.pixels_to_input`, and of features: increase it when one of them changes
        "model.dtype": config.model.dtype,
        "training.precision": config.training.precision,
        **world_model.encoder_beyond_tensors,
    }
    return Encoding(parts, world_model.image_size, world_model.num_tokens, world_model.latent_dim)


def require_same_encoder(world_model: WorldModel, dataset: Dataset, config: Config) -> None:
    """Refuse cached latents of another encoder, image size or precision; other data sets pass.

    Raises:
        InputError: Names what differs.
    """
    if isinstance(dataset.source, LatentSource):  # else the weights need not be hashed
        differing = dataset.source.key.differences_of(encoding_of(world_model, config))
        if differing:
            raise another_cache(Path(dataset.config.path), differing)


def require_widths(world_model: WorldModel, widths: Widths, *, where: str) -> None:
    """Refuse data whose states or actions do not have the width that the model takes.

    Args:
        world_model: The model.
        widths: Of the data.
        where: The source of the model's name.

    Raises:
        InputError: Names both.
    """
    if heads_to_replace(world_model.sizes, widths):
        found = f"data with states of {widths.state} and actions of {widths.action} numbers"
        needed = f"{widths_as_text(world_model.sizes)}, which this model takes"
        fix = "Choose other data, or train on these: `train` then replaces the model's input heads"
        raise InputError(where=where, found=found, needed=needed, fix=fix)


def extrinsics_for(world_model: WorldModel, batch: Batch) -> Float32[Tensor, "batch time 6"] | None:
    """Return the camera poses of a batch if the model needs them.

    Raises:
        InputError: It does, and a clip has none; names the episodes of the batch.
    """
    if not world_model.sizes.predictor.use_extrinsics:
        return None
    if batch.extrinsics is None:
        found = f"no pose of the camera in some of these episodes: {', '.join(dict.fromkeys(batch.episode_ids))}"
        fix = "Choose a data.source and data.camera that have them, or a model without use_extrinsics"
        raise InputError(where="model: predictor.use_extrinsics", found=found, fix=fix)
    return batch.extrinsics
