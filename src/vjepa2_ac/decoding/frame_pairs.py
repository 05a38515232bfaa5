"""The decoder's data: frames as the encoder saw them, and their latents. Each frame is encoded once.

A file holds the pairs of one episode and camera; it is complete once it has its name, so that a process that is killed
loses one episode at most.
"""

from __future__ import annotations

import contextlib
import hashlib
from bisect import bisect_right
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.sources.latents.dtypes import CacheType, bytes_per_frame, pack_latents, unpack_latents
from vjepa2_ac.data.transforms import input_to_pixels, pixels_to_input
from vjepa2_ac.data.windows import spread
from vjepa2_ac.encoding.cache_lookup import needed_frames
from vjepa2_ac.encoding.disk_space import GIGABYTE
from vjepa2_ac.encoding.pipeline import EncoderOnDevice
from vjepa2_ac.encoding.prefetch import FramesToEncode, Unreadable, prefetched
from vjepa2_ac.episode import Progress, StoredLatents
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import free_bytes, user_can_write, write_atomically

_LATENTS, _SCALES, _FRAMES = "latents", "scales", "frames"
_NO_SMALL_FRAMES = 1  # pixel: they are not used


@dataclass(frozen=True)
class Pairs:
    """Some frames, and the episode of each."""

    latents: Float[Tensor, "frames tokens dim"]
    images: UInt8[Tensor, "frames 3 size size"]  # what the encoder saw
    episode_ids: tuple[str, ...]


@dataclass(frozen=True)
class PairFile:
    """The file of the pairs of one episode and camera."""

    path: Path
    episode_id: str
    frames: int


class FramePairs:
    """Pairs in files, read by their number.

    Args:
        files: At least one.
    """

    def __init__(self, files: Sequence[PairFile]) -> None:
        self.files = tuple(files)

    @cached_property
    def _ends(self) -> list[int]:
        return list(accumulate(one.frames for one in self.files))

    def __len__(self) -> int:
        return self._ends[-1]

    def read(self, numbers: Sequence[int]) -> Pairs:
        """Return pairs in the given order.

        Raises:
            InputError: A file is gone or damaged.
        """
        places = []
        for number in numbers:
            file = bisect_right(self._ends, number)
            places.append((file, number - (self._ends[file - 1] if file else 0)))
        latents: list[Tensor | None] = [None] * len(places)
        images: list[Tensor | None] = [None] * len(places)
        for file in sorted({file for file, _ in places}):
            mine = [place for place, (owner, _) in enumerate(places) if owner == file]
            stored, frames = _read(self.files[file].path, [places[place][1] for place in mine])
            for place, one, frame in zip(mine, unpack_latents(stored), frames, strict=True):
                latents[place], images[place] = one, frame
        ids = tuple(self.files[file].episode_id for file, _ in places)
        return Pairs(_stacked(latents), _stacked(images), ids)


def _stacked(tensors: Sequence[Tensor | None]) -> Tensor:
    return torch.stack([one for one in tensors if one is not None])


def wanted_frames(dataset: Dataset, split: Split, *, frames: int) -> list[FramesToEncode]:
    """Return at most about this many frames of a split, spread over its episodes and cameras.

    They are among those that clips use: the decoder is to show clips. None, if the split has no clips.
    """
    members = dataset.members(split)
    needed = [one for one in needed_frames(dataset) if members[one.episode]]
    cameras = dataset.config.cameras
    total = sum(len(one.steps) for one in needed) * len(cameras)
    places, counted = np.linspace(0, total, min(frames, total), endpoint=False).astype(int), 0
    wanted = []
    for one in needed:
        for camera in cameras:
            count = int(((places >= counted) & (places < counted + len(one.steps))).sum())
            counted += len(one.steps)
            if count:
                wanted.append(FramesToEncode(one.episode, camera, one.steps[spread(len(one.steps), count)]))
    return wanted


def encode_pairs(
    dataset: Dataset,
    wanted: Sequence[FramesToEncode],
    encoder: EncoderOnDevice,
    folder: Path,
    progress: Progress,
) -> FramePairs:
    """Encode what is not there yet, and return the pairs; episodes that cannot be read are left out by policy.

    Raises:
        InputError: The disk is too small; an episode cannot be read, and `data.broken_episodes` does not skip it.
    """
    files = [_file_of(dataset, one, folder) for one in wanted]
    left = [one for one, file in zip(wanted, files, strict=True) if not file.path.is_file()]
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
    total, done = sum(len(one.steps) for one in left), 0
    with contextlib.closing(_whole_episodes(dataset, left)) as episodes:
        for one, frames in episodes:
            _write(_file_of(dataset, one, folder).path, frames, encoder, dataset.config.cache_dtype)
            done += len(frames)
            progress(done, total)
    there = [file for file in files if file.path.is_file()]
    if not there:
        raise InputError(where=dataset.config.path, found="no frame that can be read", needed="one or more")
    return FramePairs(there)


def require_space_for_pairs(
    wanted: Sequence[FramesToEncode], folder: Path, *, tokens: int, dim: int, image_size: int, kind: CacheType
) -> int:
    """Return how many bytes the pairs that are not there take.

    Raises:
        InputError: The disk has less.
    """
    frames = sum(len(one.steps) for one in wanted)
    needed = frames * (bytes_per_frame(tokens, dim, kind) + 3 * image_size**2)
    there = sum(path.stat().st_size for path in folder.glob("*.safetensors")) if folder.is_dir() else 0
    free = free_bytes(folder)
    if needed - there > free:
        raise InputError(
            where=str(folder),
            found=f"{free / GIGABYTE:.4g} GB free on its disk",
            needed=f"{(needed - there) / GIGABYTE:.4g} GB for {frames:,} frames and their latents, while training",
            fix="Lower decoder.frames, set data.cache_dtype: int8, or put decoder.folder on a larger disk",
        )
    return max(0, needed - there)


def _file_of(dataset: Dataset, wanted: FramesToEncode, folder: Path) -> PairFile:
    """Return the file of a request: its name says which frames, so that others are never taken for them."""
    steps = hashlib.sha256(np.ascontiguousarray(wanted.steps).tobytes()).hexdigest()[:8]
    camera = dataset.config.cameras.index(wanted.camera)
    name = f"{wanted.episode:07d}-{camera}-{steps}.safetensors"
    return PairFile(folder / name, dataset.table.identity(wanted.episode), len(wanted.steps))


def _whole_episodes(
    dataset: Dataset, wanted: Sequence[FramesToEncode]
) -> Generator[tuple[FramesToEncode, list[UInt8[np.ndarray, "height width 3"]]], None, None]:
    """Yield the frames of each request that can be read."""
    frames: list[np.ndarray] = []
    threads = max(1, dataset.config.workers)
    with contextlib.closing(prefetched(dataset, wanted, threads=threads, side=_NO_SMALL_FRAMES)) as parts:
        for part in parts:
            if isinstance(part, Unreadable):
                dataset.leave_out(part.wanted.episode, part.error)
                frames = []
                continue
            frames += list(part.frames)
            if len(frames) == len(part.wanted.steps):
                yield part.wanted, frames
                frames = []


def _write(path: Path, frames: Sequence[np.ndarray], encoder: EncoderOnDevice, kind: CacheType) -> None:
    size, device = encoder.world_model.image_size, encoder.device
    images, packed = [], []
    for first in range(0, len(frames), encoder.chunk):
        pixels = torch.from_numpy(np.stack(frames[first : first + encoder.chunk])).to(device)
        inputs = pixels_to_input(pixels[None], size)[0]
        images.append(input_to_pixels(inputs).cpu())
        packed.append(pack_latents(encoder.latents(inputs), kind).mapped(lambda tensor: tensor.cpu()))
    tensors = {_LATENTS: torch.cat([one.values for one in packed]), _FRAMES: torch.cat(images)}
    scales = [one.scales for one in packed if one.scales is not None]
    if scales:
        tensors[_SCALES] = torch.cat(scales)
    with user_can_write(path):
        write_atomically(path, save({name: one.contiguous() for name, one in tensors.items()}))


def _read(path: Path, rows: Sequence[int]) -> tuple[StoredLatents, UInt8[Tensor, "frames 3 size size"]]:
    try:
        with safe_open(path, framework="pt") as file:
            names = set(file.keys())
            read = {name: file.get_slice(name) for name in names}
            values = {name: torch.stack([one[row] for row in rows]) for name, one in read.items()}
        return StoredLatents(values[_LATENTS], values.get(_SCALES)), values[_FRAMES]
    except (SafetensorError, OSError, KeyError, IndexError) as error:
        fix = "Delete it: the same command encodes it again"
        raise InputError(where=str(path), found=f"cannot be read ({error})", fix=fix) from None


def as_images(pixels: UInt8[Tensor, "*batch 3 size size"]) -> Float[Tensor, "*batch 3 size size"]:
    """Return images as the decoder gives them: black 0, white 1."""
    return pixels.float() / 255.0


def as_pixels(images: Float[Tensor, "*batch 3 size size"]) -> UInt8[np.ndarray, "*batch size size 3"]:
    """Return images between 0 and 1 for files: rounded to 8 bits, colours last."""
    rounded = (images.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu()
    return np.asarray(rearrange(rounded, "... c h w -> ... h w c").numpy())
