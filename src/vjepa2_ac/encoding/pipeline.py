"""Encoding of frames into files: threads decode ahead, the encoder computes, and threads write whole files."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from operator import itemgetter

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, Int32, UInt8
from torch import Tensor

from vjepa2_ac import storage
from vjepa2_ac.config import Config
from vjepa2_ac.data.clips import joined_latents
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.sources.latent_files import CacheType, EncodedEpisode, LatentFiles, pack_latents
from vjepa2_ac.data.transforms import input_to_pixels, pixels_to_input, view
from vjepa2_ac.distributed import autocast
from vjepa2_ac.episode import Episode, Progress, StoredLatents, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.encoder import ENCODE_CHUNK
from vjepa2_ac.model.world_model import WorldModel

FRAMES_AT_ONCE = 64  # decoded in one go: a run of a video, and 180 MB of 720p at most
_PREFETCHED_PARTS = 2  # per thread: one in progress, and one ready
_WRITES_UNDER_WAY = 2  # files: limits the memory


@dataclass(frozen=True, eq=False)
class FramesToEncode:
    """Frames to encode, of one camera of one episode."""

    episode: int  # index into the data set's table
    camera: str
    steps: Int32[np.ndarray, " frames"]  # control steps, ascending


@dataclass(frozen=True, eq=False)
class EncoderOnDevice:
    """The frozen encoder of a model on its device, and its settings."""

    world_model: WorldModel
    device: torch.device
    autocast: Callable[[], contextlib.AbstractContextManager[object]]
    chunk: int = ENCODE_CHUNK  # frames at once

    @classmethod
    def of(cls, config: Config, model: WorldModel, device: torch.device) -> EncoderOnDevice:
        """Move the encoder of a model, and only the encoder, to a device."""
        model.present_encoder.to(device)
        return cls(model, device, partial(autocast, config.training, device))

    @torch.no_grad()
    def latents(self, inputs: Float[Tensor, "time 3 size size"]) -> Float[Tensor, "time tokens dim"]:
        """Return the latents of normalised frames."""
        with self.autocast():
            return self.world_model.encode(inputs[None], chunk=self.chunk)[0]


_Frames = UInt8[Tensor, "frames height width 3"]  # cropped
_Parts = Iterator[tuple[FramesToEncode, Future[tuple[Episode, _Frames]]]]  # neighbouring frames of a request


def encode_files(
    dataset: Dataset,
    wanted: Sequence[FramesToEncode],
    encoder: EncoderOnDevice,
    files: LatentFiles,
    progress: Progress = no_progress,
    *,
    exact_pictures: bool = False,
) -> None:
    """Write the file of each request; an episode that cannot be read is left out by `data.broken_episodes`, and noted.

    A file gets its name when it is complete: a kill loses only those in progress.

    Args:
        dataset: Source of the frames.
        wanted: The requests.
        encoder: Makes the latents.
        files: Where they go.
        progress: Called with (done, total) in frames.
        exact_pictures: Store the frames as the encoder saw them bit for bit, not as JPEGs.

    Raises:
        InputError: An episode cannot be read and the policy does not skip it, or too many are; or a file cannot be
            written. Written files stay.
        UnreachableError: A failure of the connection, not of the episode.
    """
    threads, writes = max(1, dataset.config.workers), deque[Future[None]]()
    done, total = 0, sum(len(one.steps) for one in wanted)
    progress(done, total)
    writers = _WRITES_UNDER_WAY if storage.is_url(files.folder) else 1
    with ThreadPoolExecutor(threads, "decode") as decoders, ThreadPoolExecutor(writers, "write") as writer:
        parts_ahead = _parts(decoders, dataset, wanted, encoder, threads * _PREFETCHED_PARTS)
        try:
            for one, parts in groupby(parts_ahead, itemgetter(0)):
                try:
                    encoded = _encode(encoder, one, parts, dataset.config.cache_dtype)
                except InputError as error:
                    dataset.leave_out(one.episode, error)
                    files.note_broken(one.episode, one.camera, str(error))
                else:
                    writes.append(writer.submit(_write, files, one.episode, encoded, exact_pictures=exact_pictures))
                while len(writes) > _WRITES_UNDER_WAY:
                    writes.popleft().result()
                done += len(one.steps)
                progress(done, total)
            for write in writes:
                write.result()
        finally:
            decoders.shutdown(cancel_futures=True)


def _parts(
    pool: ThreadPoolExecutor,
    dataset: Dataset,
    wanted: Sequence[FramesToEncode],
    encoder: EncoderOnDevice,
    ahead: int,
) -> _Parts:
    """Yield parts in the requested order, while threads read the next ones; an episode is opened once."""
    frames = encoder.chunk * max(1, FRAMES_AT_ONCE // encoder.chunk)  # whole chunks, but for the last of an episode
    waiting = deque[tuple[FramesToEncode, Future[tuple[Episode, _Frames]]]]()
    for one in wanted:
        recording = pool.submit(dataset.read, one.episode, one.camera)
        for first in range(0, len(one.steps), frames):
            steps = one.steps[first : first + frames].tolist()
            pinned = encoder.device.type == "cuda"
            waiting.append((one, pool.submit(_read, dataset, recording, steps, pinned=pinned)))
            if len(waiting) > ahead:
                yield waiting.popleft()
    while waiting:
        yield waiting.popleft()


def _read(dataset: Dataset, opened: Future[Episode], steps: Sequence[int], *, pinned: bool) -> tuple[Episode, _Frames]:
    recording = opened.result()
    frames = torch.from_numpy(view(recording.read_frames(steps), dataset.config.crop))
    return recording, frames.pin_memory() if pinned else frames


def _encode(
    encoder: EncoderOnDevice, one: FramesToEncode, parts: _Parts, kind: CacheType
) -> Callable[[], EncodedEpisode]:
    """Encode an episode, and return a function that waits for the results."""
    latents, pictures = list[StoredLatents](), list[Tensor]()
    for _, part in parts:
        recording, frames = part.result()
        pixels = frames.to(encoder.device, non_blocking=True)
        inputs = pixels_to_input(pixels[None], encoder.world_model.image_size)[0]
        latents.append(pack_latents(encoder.latents(inputs), kind).mapped(_to_host))
        pictures.append(_to_host(input_to_pixels(inputs)))

    def fetched() -> EncodedEpisode:
        if encoder.device.type == "cuda":
            torch.cuda.synchronize(encoder.device)
        seen = np.ascontiguousarray(rearrange(torch.cat(pictures), "n c h w -> n h w c").numpy())
        return EncodedEpisode(recording, one.camera, one.steps.tolist(), joined_latents(latents, torch.cat), seen)

    return fetched


def _to_host(tensor: Tensor) -> Tensor:
    """Return a copy in the host's memory; from a GPU it is only enqueued: the next part need not wait."""
    if not tensor.is_cuda:
        return tensor.cpu()
    return torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True).copy_(tensor, non_blocking=True)


def _write(files: LatentFiles, number: int, encoded: Callable[[], EncodedEpisode], *, exact_pictures: bool) -> None:
    files.write(number, encoded(), exact_pictures=exact_pictures)
