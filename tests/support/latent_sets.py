"""Latent caches for tests: encoded with a tiny model, or of numbers that encode the step."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.sources.latents.cache_key import Encoding
from vjepa2_ac.data.sources.latents.dtypes import pack_latents
from vjepa2_ac.data.sources.latents.episode_file import EncodedEpisode
from vjepa2_ac.data.transforms import pixels_to_input, view
from vjepa2_ac.encoding.batch import encoding_of
from vjepa2_ac.encoding.cache_lookup import folder_of, key_for, needed_frames
from vjepa2_ac.encoding.cache_writer import CacheWriter
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.world_model import WorldModel

Frames = UInt8[np.ndarray, "frames height width 3"]
Encode = Callable[[np.ndarray], torch.Tensor]  # cropped frames to latents

NUMBERS = Encoding("numbers", 16, 8, tokens=4, dim=8, weights="float32", precision="fp32")


def as_numbers(frames: np.ndarray) -> torch.Tensor:
    """Return latents that hold the colour of a frame's middle, and so tell which frame it is."""
    middle = torch.from_numpy(frames[:, frames.shape[1] // 2, frames.shape[2] // 2].astype(np.float32))
    return torch.cat([middle, middle, middle[:, :2]], dim=1)[:, None].repeat(1, NUMBERS.tokens, 1)


def write_cache(dataset: Dataset, encoding: Encoding = NUMBERS, encode: Encode = as_numbers) -> Path:
    """Write the cache of a data set where it is looked for, and return its folder."""
    key = key_for(dataset, encoding)
    writer = CacheWriter(folder_of(dataset.config, key), key, encoding)
    broken, count = {}, 0
    for needed in needed_frames(dataset):
        for camera in dataset.config.cameras:
            try:
                episode = dataset.source.read(needed.episode, camera)
                frames = view(episode.read_frames(needed.steps.tolist()), dataset.config.crop)
            except InputError as error:
                broken[dataset.table.identity(needed.episode)] = str(error)
                continue
            count += len(frames)
            latents = pack_latents(encode(frames), key.kind)
            encoded = EncodedEpisode(episode, camera, needed.steps.tolist(), latents, _squashed(frames, 16))
            writer.write_episode(needed.episode, encoded)
    writer.finish(dataset, broken=broken, frames=count)
    return writer.folder


def encode_for(config: Config, world_model: WorldModel, dataset: Dataset) -> Path:
    """Encode a data set with the encoder of a model, as a run of this config would on the fly."""

    def encode(frames: np.ndarray) -> torch.Tensor:
        inputs = pixels_to_input(torch.from_numpy(np.ascontiguousarray(frames))[None], world_model.image_size)
        is_bf16 = config.training.precision == "bf16"
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=is_bf16):
            return world_model.encode(inputs, chunk=config.model.encode_chunk)[0]

    return write_cache(dataset, encoding_of(world_model, config), encode)


def _squashed(frames: Frames, side: int) -> Frames:
    """Return every so-many-th pixel of frames: square and small."""
    rows, columns = (np.arange(side) * length // side for length in frames.shape[1:3])
    return frames[:, rows][:, :, columns]
