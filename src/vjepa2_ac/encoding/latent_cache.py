"""The latent cache of an open data set: the frames that clips need, the cache's key and folder, and the encoding.

Encoding is a pipeline: threads decode frames in advance, the encoder computes latents, and threads write the files.
"""

from __future__ import annotations

import contextlib
import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, Int32, UInt8
from torch import Tensor

from vjepa2_ac import storage
from vjepa2_ac.config import Config
from vjepa2_ac.data.clips import join_latents
from vjepa2_ac.data.dataset import Dataset, open_cached_latents
from vjepa2_ac.data.files import CONNECTIONS, map_in_threads, open_download_cache
from vjepa2_ac.data.idle import find_ranges
from vjepa2_ac.data.index import cache_folder, compute_fingerprint
from vjepa2_ac.data.sources.latent_files import CacheType, EncodedEpisode, LatentFiles, bytes_per_frame, pack_latents
from vjepa2_ac.data.sources.latents import (
    CACHE_FILE,
    EPISODES_FILE,
    STEPS_FILE,
    CacheKey,
    Encoding,
    build_cache_key,
    read_cache_key,
    require_matching_folder,
)
from vjepa2_ac.data.transforms import crop_frames, input_to_pixels, pixels_to_input
from vjepa2_ac.distributed import autocast
from vjepa2_ac.episode import Episode, Progress, StoredLatents, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.model.encoder import ENCODE_CHUNK
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.storage import free_bytes

_GIGABYTE = 10**9
FRAMES_AT_ONCE = 64  # consecutive frames of an episode that are decoded together: at most 180 MB at 720p
_PREFETCHED_PARTS = 2  # parts per thread: one in progress and one ready
_MAX_PENDING_WRITES = 2  # number of files; limits the memory use


@dataclass(frozen=True, eq=False)
class FramesToEncode:
    """The frames to encode from one camera of one episode."""

    episode: int  # index into the data set's table
    camera: str
    steps: Int32[np.ndarray, " frames"]  # control steps, ascending


def needed_frames(dataset: Dataset) -> Iterator[FramesToEncode]:
    """Yield the frames that clips of any split use, for each episode and camera, in the data set's order.

    Episodes without clips are not included: they are shorter than a clip, excluded or completely idle.
    """
    starts, config = dataset.starts, dataset.config
    offsets = np.arange(config.frames) * config.model_stride
    order = np.argsort(starts.episode, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(starts.episode[order])) + 1):
        if not len(rows):
            return  # a data set without clips
        first_steps = np.concatenate([starts.steps_of(int(row)) for row in rows])
        steps = np.unique(first_steps[:, None] + offsets).astype(np.int32)
        for camera in config.cameras:
            yield FramesToEncode(int(starts.episode[rows[0]]), camera, steps)


@dataclass(frozen=True, eq=False)
class LatentCache:
    """The latent cache of a `Dataset`, finished or not. Several processes may write into its folder.

    The cache is finished when no file is missing. It needs no repair after a process was killed, a file was deleted or
    an episode was added: the next encoding writes the missing files.
    """

    dataset: Dataset
    encoding: Encoding
    key: CacheKey
    folder: Path | str  # local folder or URL

    @classmethod
    def for_dataset(cls, dataset: Dataset, encoding: Encoding, folder: Path | str | None = None) -> LatentCache:
        """Return the cache for a data set and an encoder.

        Args:
            dataset: A data set of frames, which is not itself a cache.
            encoding: The settings that determine the latents of a frame.
            folder: The folder of the cache; None: a folder in `data.cache_dir` or in the disk cache of this machine.
        """
        config = dataset.config
        key = build_cache_key(config, compute_fingerprint(dataset.table), encoding)
        parent = config.cache_dir or cache_folder(config.disk_cache) / "latents"
        path = storage.join(parent, key.digest) if folder is None else str(folder)
        return cls(dataset, encoding, key, storage.parse_folder(path))

    @property
    def files(self) -> LatentFiles:
        """The files of the cache. With a URL each access of this property lists the folder again."""
        cache = open_download_cache(self.dataset.config.disk_cache) if storage.is_url(self.folder) else None
        return LatentFiles(self.folder, self.key.digest, cache)

    @cached_property
    def requests(self) -> tuple[FramesToEncode, ...]:
        """The frames that the finished cache contains."""
        return tuple(needed_frames(self.dataset))

    def missing(self, *, retry: bool = False) -> list[FramesToEncode]:
        """Return the frames whose file is missing; with `retry`, also the frames of unreadable episodes.

        The header of each local file is read: a damaged file counts as missing and is encoded again. With a URL headers
        are read only with `retry`.
        """
        if not self.is_begun:
            return list(self.requests)
        files = self.files
        is_present = files.has_file if retry else files.is_done
        results = map_in_threads(
            lambda request: is_present(request.episode, request.camera), self.requests, CONNECTIONS
        )
        return [request for request, is_complete in zip(self.requests, results, strict=True) if not is_complete]

    @property
    def is_begun(self) -> bool:
        """Whether the files that describe the cache exist (`begin` writes them)."""
        return all(storage.exists(storage.join(self.folder, name)) for name in (CACHE_FILE, EPISODES_FILE))

    @property
    def broken(self) -> dict[int, str]:
        """Why a process could not read an episode, by the index of the episode; readable episodes are not included."""
        reasons, episodes = self.files.broken_reasons, {request.episode for request in self.requests}
        return {episode: reason for episode, reason in reasons.items() if episode in episodes}

    @property
    def bytes_per_frame(self) -> int:
        """The approximate size of a frame in bytes: its latents and its image."""
        encoding = self.encoding
        latents = bytes_per_frame(encoding.tokens, encoding.dim, self.dataset.config.cache_dtype)
        return latents + image_bytes(encoding.image_size)

    def summary(self, missing: Sequence[FramesToEncode]) -> str:
        """Return the number of frames and the size of the cache as text, and the number of frames to encode."""
        frames, num_missing = count_frames(self.requests), count_frames(missing)
        size = f"{counted(frames, 'frame')} ({frames * self.bytes_per_frame / _GIGABYTE:.3g} GB)"
        return size if num_missing == frames else f"{size}; {frames - num_missing:,} cached, {num_missing:,} to encode"

    def require_same_key(self) -> None:
        """Refuse a folder that contains another cache or other files.

        Raises:
            InputError: The folder contains other files, or another cache; the message lists how the caches differ.
        """
        require_matching_folder(self.folder, CACHE_FILE, self.key, where=f"latent cache {self.folder}")

    def begin(self) -> None:
        """Write the files that describe the cache, unless they exist.

        Raises:
            InputError: The folder contains another cache or other files, or cannot be written.
            UnreachableError: The URL cannot be written.
        """
        self.require_same_key()
        if self.is_begun:
            return
        dataset = self.dataset
        texts = {"control_rate_hz": str(dataset.control_rate_hz), "widths": " ".join(map(str, dataset.widths))}
        table = replace(dataset.table, texts={**dataset.table.texts, **texts}, locators={})
        content: dict[str, bytes | str] = {CACHE_FILE: json.dumps({"key": dict(self.key.parts)}, indent=1) + "\n"}
        if dataset.config.idle.rule != "none":
            content[STEPS_FILE] = find_ranges(dataset.source, dataset.table, dataset.config, None).to_bytes()
        for name, data in {**content, EPISODES_FILE: table.to_bytes()}.items():
            storage.write(storage.join(self.folder, name), data)

    def require_space(self, missing: Sequence[FramesToEncode]) -> None:
        """Refuse to start if the local disk has too little space for the missing frames; URLs are not checked.

        Raises:
            InputError: The disk has too little space; the message states the free and the required space, and a fix.
        """
        if not isinstance(self.folder, Path):
            return
        fix = (
            f"Set data.cache_dtype: int8 or data.start_every: {self.dataset.config.model_stride}, use fewer episodes"
            " (data.outcome, data.idle, data.exclude), or set data.cache_dir to a folder on a larger disk"
        )
        require_space(self.folder, count_frames(missing), self.bytes_per_frame, fix=fix)

    def open_dataset(self) -> Dataset:
        """Return the same data set, with the same clips in the same order, read as latents from this cache.

        Raises:
            InputError: The cache is not finished. If it does not exist, the message names the most similar other cache.
        """
        if self.is_begun:
            return open_cached_latents(self.dataset, self.folder)
        parent, other_caches = str(self.folder).rpartition("/")[0], []
        for name in storage.list_names(parent):
            if storage.exists(storage.join(other_folder := storage.join(parent, name), CACHE_FILE)):
                differing = read_cache_key(other_folder).list_differences(self.key.parts)
                other_caches.append((len(differing), f"{name}, which differs: {'; '.join(differing)}"))
        nearest = (
            f". The folder has {counted(len(other_caches), 'other cache')}. Most similar: {min(other_caches)[1]}"
            if other_caches
            else ""
        )
        where = f"data.cache: {self.dataset.config.cache}: {self.folder}"
        fix = "Run `vjepa2-ac encode` with this config, or set data.cache: auto"
        raise InputError(where=where, found=f"no latent cache for this model and these settings{nearest}", fix=fix)


def count_frames(requests: Sequence[FramesToEncode]) -> int:
    """Return the total number of frames of these requests."""
    return sum(len(request.steps) for request in requests)


def image_bytes(image_size: int) -> int:
    """Return the approximate size in bytes of a frame's JPEG image and the frame's states."""
    return 1000 + image_size**2 // 3


def require_space(folder: Path, frames: int, per_frame: int, *, fix: str) -> None:
    """Refuse to encode frames if the disk has too little space.

    Args:
        folder: A folder on the disk, which need not exist.
        frames: Number of frames.
        per_frame: Size of a frame in bytes.
        fix: The fix, for messages.

    Raises:
        InputError: The space is too small; the message has the free and the required space.
    """
    needed, free = frames * per_frame, free_bytes(folder)
    if needed > free:
        size = f"{needed / _GIGABYTE:.4g} GB for {frames:,} frames ({per_frame / 1e6:.3g} MB each)"
        raise InputError(where=str(folder), found=f"{free / _GIGABYTE:.4g} GB free on the disk", needed=size, fix=fix)


# ---- encoding ----


@dataclass(frozen=True, eq=False)
class EncoderOnDevice:
    """The frozen encoder of a model on its device, and its settings."""

    world_model: WorldModel
    device: torch.device
    autocast: Callable[[], contextlib.AbstractContextManager[object]]
    chunk: int = ENCODE_CHUNK  # frames per encoder call

    @classmethod
    def from_model(cls, config: Config, model: WorldModel, device: torch.device) -> EncoderOnDevice:
        """Move only the encoder of a model to a device, and return it with the settings of the config."""
        model.loaded_encoder.to(device)
        return cls(model, device, partial(autocast, config.training, device))

    @torch.no_grad()
    def latents(self, inputs: Float[Tensor, "time 3 size size"]) -> Float[Tensor, "time tokens dim"]:
        """Return the latents of normalised frames."""
        with self.autocast():
            return self.world_model.encode(inputs[None], chunk=self.chunk)[0]


_Frames = UInt8[Tensor, "frames height width 3"]  # cropped
_Parts = Iterator[tuple[FramesToEncode, Future[tuple[Episode, _Frames]]]]  # consecutive frames of a request


def encode_files(
    dataset: Dataset,
    requests: Sequence[FramesToEncode],
    encoder: EncoderOnDevice,
    files: LatentFiles,
    progress: Progress = no_progress,
    *,
    lossless_images: bool = False,
) -> None:
    """Encode the requested frames and write one file per request.

    An episode that cannot be read is recorded in the cache; `data.broken_episodes` determines whether it is skipped.
    Files are written atomically, so a killed process loses only the files in progress.

    Args:
        dataset: Source of the frames.
        requests: The frames to encode.
        encoder: Computes the latents.
        files: The files of the cache.
        progress: Called with (done, total) in frames.
        lossless_images: Store the encoder's input images without loss instead of as JPEGs.

    Raises:
        InputError: An episode cannot be read and is not skipped, too many episodes are broken, or a file cannot be
            written. Files that were written before remain.
        UnreachableError: The connection failed; the episode is not recorded as broken.
    """
    threads, writes = max(1, dataset.config.workers), deque[Future[None]]()
    num_done, total = 0, count_frames(requests)
    progress(num_done, total)
    writers = _MAX_PENDING_WRITES if storage.is_url(files.folder) else 1
    with ThreadPoolExecutor(threads, "decode") as decoders, ThreadPoolExecutor(writers, "write") as writer:
        parts_ahead = _read_ahead(decoders, dataset, requests, encoder, threads * _PREFETCHED_PARTS)
        try:
            for request, parts in groupby(parts_ahead, itemgetter(0)):
                try:
                    encoded = _start_encoding(encoder, request, parts, dataset.config.cache_dtype)
                except InputError as error:
                    dataset.skip_episode(request.episode, error)
                    files.record_broken(request.episode, request.camera, str(error))
                else:
                    writes.append(
                        writer.submit(_write, files, request.episode, encoded, lossless_images=lossless_images)
                    )
                while len(writes) > _MAX_PENDING_WRITES:
                    writes.popleft().result()
                num_done += len(request.steps)
                progress(num_done, total)
            for write in writes:
                write.result()
        finally:
            decoders.shutdown(cancel_futures=True)


def _read_ahead(
    pool: ThreadPoolExecutor,
    dataset: Dataset,
    requests: Sequence[FramesToEncode],
    encoder: EncoderOnDevice,
    ahead: int,
) -> _Parts:
    """Yield parts in the order of the requests, while threads read up to `ahead` further parts.

    Each episode is opened once.
    """
    part_size = encoder.chunk * max(1, FRAMES_AT_ONCE // encoder.chunk)  # frames: whole chunks, except in the last part
    queue = deque[tuple[FramesToEncode, Future[tuple[Episode, _Frames]]]]()
    for request in requests:
        episode = pool.submit(dataset.read, request.episode, request.camera)
        for first in range(0, len(request.steps), part_size):
            steps = request.steps[first : first + part_size].tolist()
            is_pinned = encoder.device.type == "cuda"
            queue.append((request, pool.submit(_read_frames, dataset, episode, steps, is_pinned=is_pinned)))
            if len(queue) > ahead:
                yield queue.popleft()
    while queue:
        yield queue.popleft()


def _read_frames(
    dataset: Dataset, episode_future: Future[Episode], steps: Sequence[int], *, is_pinned: bool
) -> tuple[Episode, _Frames]:
    episode = episode_future.result()
    frames = torch.from_numpy(crop_frames(episode.read_frames(steps), dataset.config.crop))
    return episode, frames.pin_memory() if is_pinned else frames


def _start_encoding(
    encoder: EncoderOnDevice, request: FramesToEncode, parts: _Parts, kind: CacheType
) -> Callable[[], EncodedEpisode]:
    """Start to encode an episode, and return a function that waits for the result."""
    latents, inputs_as_pixels = list[StoredLatents](), list[Tensor]()
    for _, part in parts:
        episode, frames = part.result()
        pixels = frames.to(encoder.device, non_blocking=True)
        inputs = pixels_to_input(pixels[None], encoder.world_model.image_size)[0]
        latents.append(pack_latents(encoder.latents(inputs), kind).map_tensors(_to_host))
        inputs_as_pixels.append(_to_host(input_to_pixels(inputs)))

    def finish() -> EncodedEpisode:
        if encoder.device.type == "cuda":
            torch.cuda.synchronize(encoder.device)
        images = np.ascontiguousarray(rearrange(torch.cat(inputs_as_pixels), "n c h w -> n h w c").numpy())
        return EncodedEpisode(episode, request.camera, request.steps.tolist(), join_latents(latents, torch.cat), images)

    return finish


def _to_host(tensor: Tensor) -> Tensor:
    """Return a copy in host memory. A copy from a GPU is asynchronous, so the next part can start before it ends."""
    if not tensor.is_cuda:
        return tensor.cpu()
    return torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True).copy_(tensor, non_blocking=True)


def _write(files: LatentFiles, number: int, encoded: Callable[[], EncodedEpisode], *, lossless_images: bool) -> None:
    files.write(number, encoded(), lossless_images=lossless_images)
