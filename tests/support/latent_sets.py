"""Latent caches for tests, encoded with a tiny model or with numbers that identify the step."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from safetensors import safe_open

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.sources.latent_files import EncodedEpisode, pack_latents
from vjepa2_ac.data.sources.latents import Encoding
from vjepa2_ac.data.transforms import crop_frames, pixels_to_input
from vjepa2_ac.encoding.batch import get_encoding
from vjepa2_ac.encoding.latent_cache import LatentCache
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.world_model import WorldModel

Frames = UInt8[np.ndarray, "frames height width 3"]
Encode = Callable[[np.ndarray], torch.Tensor]  # cropped frames to latents

NUMBERS = Encoding({"encoder": "numbers", "training.precision": "fp32"}, image_size=16, tokens=4, dim=8)


def as_numbers(frames: np.ndarray) -> torch.Tensor:
    """Return latents that contain the colour of a frame's middle, which identifies the frame."""
    middle = torch.from_numpy(frames[:, frames.shape[1] // 2, frames.shape[2] // 2].astype(np.float32))
    return torch.cat([middle, middle, middle[:, :2]], dim=1)[:, None].repeat(1, NUMBERS.tokens, 1)


def write_cache(dataset: Dataset, encoding: Encoding = NUMBERS, encode: Encode = as_numbers) -> Path:
    """Write the cache of a data set to its default folder, and return the folder."""
    cache = LatentCache.for_dataset(dataset, encoding)
    cache.begin()
    for request in cache.requests:
        try:
            episode = dataset.source.read(request.episode, request.camera)
            frames = crop_frames(episode.read_frames(request.steps.tolist()), dataset.config.crop)
        except InputError as error:
            cache.files.record_broken(request.episode, request.camera, str(error))
            continue
        latents = pack_latents(encode(frames), dataset.config.cache_dtype)
        encoded = EncodedEpisode(episode, request.camera, request.steps.tolist(), latents, _downsample(frames, 16))
        cache.files.write(request.episode, encoded)
    return cache.folder


def encode_for(config: Config, world_model: WorldModel, dataset: Dataset) -> Path:
    """Encode a data set with the encoder of a model, as a run with this config would; return the cache's folder."""

    def encode(frames: np.ndarray) -> torch.Tensor:
        inputs = pixels_to_input(torch.from_numpy(np.ascontiguousarray(frames))[None], world_model.image_size)
        is_bf16 = config.training.precision == "bf16"
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=is_bf16):
            return world_model.encode(inputs)[0]

    return write_cache(dataset, get_encoding(world_model, config), encode)


def _downsample(frames: Frames, side: int) -> Frames:
    """Return frames of `side` x `side` evenly spaced pixels."""
    rows, columns = (np.arange(side) * length // side for length in frames.shape[1:3])
    return frames[:, rows][:, :, columns]


def files_of(folder: Path) -> dict[str, bytes]:
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix != ".partial"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def contents(folder: Path) -> dict[str, object]:
    """Return the contents of all files of a cache, independently of the order of tensors in a header."""
    return {
        name: opened(folder / name) if name.endswith(".safetensors") else data
        for name, data in files_of(folder).items()
    }


def opened(path: Path) -> object:
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name).flatten().view(torch.uint8).tolist() for name in file.keys()}  # noqa: SIM118
        return tensors, file.metadata()


def latents_in(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.safetensors"))
