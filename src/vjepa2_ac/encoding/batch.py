"""Batches of latents, computed by the frozen encoder or read from a latent cache.

Training, evaluation and planning receive latents only from this module.
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
from vjepa2_ac.data.sources.latents import Encoding, LatentSource, cache_mismatch_error
from vjepa2_ac.data.transforms import Crop, crop_frames, pixels_to_input, split_views
from vjepa2_ac.episode import Batch, LatentBatch, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.encoder import ENCODE_CHUNK
from vjepa2_ac.model.world_model import WorldModel, describe_model_widths, find_projections_to_replace


@torch.no_grad()
def encode_batch(
    world_model: WorldModel, batch: Batch, *, device: torch.device, chunk: int = ENCODE_CHUNK
) -> LatentBatch:
    """Encode the frames of a batch on the device, each frame independently.

    A batch from a latent cache already contains latents; `require_same_encoder` checks that their encoder is the same.

    Args:
        world_model: The model whose frozen encoder is used.
        batch: Clips from the loader, as cropped uint8 frames of any size or as latents.
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
        raise ValueError("a batch without frames and latents")
    return LatentBatch(
        latents=latents,
        states=batch.states,
        actions=batch.actions,
        extrinsics=get_extrinsics(world_model, batch),
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
    """Encode camera frames on the model's device, each frame independently, and return their latents.

    Several views side by side in a frame are encoded separately, and their tokens are concatenated.

    Args:
        world_model: The model whose frozen encoder is used.
        frames: RGB, uncropped, of any size.
        crop: The kind of crop before encoding.
        chunk: Frames per encoder call; only the pixels of these frames are on the device at once.
        views: Number of cameras side by side in each frame.

    Raises:
        InputError: The width of the frames is not a multiple of the number of views.
    """

    def encode_part(part: UInt8[np.ndarray, "frames height all 3"]) -> Tensor:
        cropped = crop_frames(split_views(part, views), crop)
        pixels = torch.from_numpy(np.ascontiguousarray(cropped)).to(world_model.device)[None]
        latents = world_model.encode(pixels_to_input(pixels, world_model.image_size), chunk=chunk)[0]
        return latents.reshape(len(part), -1, latents.shape[-1])

    return torch.cat([encode_part(frames[first : first + chunk]) for first in range(0, len(frames), chunk)])


def get_encoding(world_model: WorldModel, config: Config) -> Encoding:
    """Return the settings that determine a model's latents. They are part of the key of a latent cache.

    This function is slow, because it hashes the encoder's weights.
    """
    parts = {
        "encoder": world_model.encoder_fingerprint(),
        "image_size": world_model.image_size,
        "patch_size": world_model.sizes.patch_size,
        "normalisation": 1,  # version of `transforms.pixels_to_input` and `normalise_latents`
        "model.dtype": config.model.dtype,
        "training.precision": config.training.precision,
        **world_model.encoder_properties,
    }
    return Encoding(parts, world_model.image_size, world_model.num_tokens, world_model.latent_dim)


def require_same_encoder(world_model: WorldModel, dataset: Dataset, config: Config) -> None:
    """Refuse a latent cache from another encoder, image size or precision; data sets of frames are accepted.

    Raises:
        InputError: The settings of the cache differ; the message lists the differences.
    """
    if isinstance(dataset.source, LatentSource):  # the weights are hashed only for caches
        differing = dataset.source.key.list_encoding_differences(get_encoding(world_model, config))
        if differing:
            raise cache_mismatch_error(Path(dataset.config.path), differing)


def require_widths(world_model: WorldModel, widths: Widths, *, where: str) -> None:
    """Refuse data whose states or actions do not have the widths that the model expects.

    Args:
        world_model: The model.
        widths: Widths of states and actions of the data.
        where: The config key or option that names the model, for messages.

    Raises:
        InputError: The widths differ.
    """
    if find_projections_to_replace(world_model.sizes, widths):
        problem = f"data with states of {widths.state} and actions of {widths.action} numbers"
        needed = f"{describe_model_widths(world_model.sizes)}, as this model requires"
        fix = "Choose other data, or train on this data: `train` replaces the model's input projections"
        raise InputError(where=where, found=problem, needed=needed, fix=fix)


def get_extrinsics(world_model: WorldModel, batch: Batch) -> Float32[Tensor, "batch time 6"] | None:
    """Return the camera poses of a batch if the model needs them, otherwise None.

    Raises:
        InputError: The model needs camera poses and a clip has none; the message names the episodes of the batch.
    """
    if not world_model.sizes.predictor.use_extrinsics:
        return None
    if batch.extrinsics is None:
        problem = f"no camera pose in some of these episodes: {', '.join(dict.fromkeys(batch.episode_ids))}"
        fix = "Choose a data.source and data.camera with camera poses, or a model without use_extrinsics"
        raise InputError(where="model: predictor.use_extrinsics", found=problem, fix=fix)
    return batch.extrinsics
