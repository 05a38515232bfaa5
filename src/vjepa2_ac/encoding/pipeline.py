"""The encoding pipeline: prefetched frames, encoded in chunks, written as one file per episode.

An episode is complete once its file has its final name: a process that is killed loses only the episodes in progress.
The process that finds nothing missing finalizes the cache.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.data.clips.streams import copies_for
from vjepa2_ac.data.sources.latents.dtypes import pack_latents
from vjepa2_ac.data.sources.latents.episode_file import EncodedEpisode
from vjepa2_ac.data.sources.latents.manifest import Manifest
from vjepa2_ac.encoding.batching import Chunks, Encode, Encoded
from vjepa2_ac.encoding.disk_space import small_frame_side
from vjepa2_ac.encoding.prefetch import Unreadable, prefetched
from vjepa2_ac.encoding.workload import Workload, broken_in, forget_broken, note_broken
from vjepa2_ac.episode import Progress, StoredLatents, no_progress
from vjepa2_ac.model.network.world_model import WorldModel

_WRITES_UNDER_WAY = 2  # files: limits the memory

Autocast = Callable[[], contextlib.AbstractContextManager[object]]


@dataclass(frozen=True, eq=False)
class EncoderOnDevice:
    """The frozen encoder of a model on its device, and its settings."""

    world_model: WorldModel
    device: torch.device
    autocast: Autocast
    chunk: int  # frames at once

    @torch.no_grad()
    def latents(self, inputs: Float[Tensor, "time 3 size size"]) -> Float[Tensor, "time tokens dim"]:
        """Return the latents of normalised frames."""
        with self.autocast():
            return self.world_model.encode(inputs[None], chunk=self.chunk)[0]


def build(
    work: Workload, encoder: EncoderOnDevice, *, threads: int, progress: Progress = no_progress
) -> Manifest | None:
    """Encode the share of this process, and finalize the cache if nothing is missing by then.

    Args:
        work: The work.
        encoder: The encoder.
        threads: Number of threads that decode frames in advance.
        progress: Called with (done, total) in frames of this process.

    Returns:
        The manifest of the cache; None while other processes are still encoding.

    Raises:
        InputError: An episode cannot be read and `data.broken_episodes` does not skip it, or too many are; or the
            folder cannot be written. Written files stay.
    """
    folder, dataset = work.writer.folder, work.dataset
    for episode in sorted({one.episode for one in work.left}):
        forget_broken(folder, episode)
    for frames in _written(work, encoder, threads) if work.left else ():
        progress(frames, work.frames_left)
    if work.is_incomplete:
        return None
    broken = broken_in(folder)
    for name, reason in broken.items():
        dataset.broken.met(name, reason)  # of the other processes, too: together they may be too many
    return work.writer.finish(dataset, broken=broken, frames=work.frames)


def _written(work: Workload, encoder: EncoderOnDevice, threads: int) -> Iterator[int]:
    """Write episode after episode; yield the number of finished frames, first 0; those of unreadable ones count."""
    yield 0
    side = small_frame_side(encoder.world_model.image_size)
    chunks = Chunks(
        _storing(work, encoder),
        chunk=encoder.chunk,
        image_size=encoder.world_model.image_size,
        copies=copies_for(encoder.device),
    )
    done, under_way = 0, deque[tuple[Future[int], int]]()
    decoded = prefetched(work.dataset, work.left, threads=threads, side=side)
    with contextlib.closing(decoded), ThreadPoolExecutor(1, thread_name_prefix="write") as pool:
        for one in chunks.encoded(decoded):
            if isinstance(one, Unreadable):
                _leave_out(work, one)
                done += len(one.wanted.steps)
                yield done
            else:
                under_way.append((pool.submit(_write, work, one), len(one.wanted.steps)))
            while len(under_way) > _WRITES_UNDER_WAY or (under_way and under_way[0][0].done()):
                done += _waited_for(under_way)
                yield done
        while under_way:
            done += _waited_for(under_way)
            yield done


def _waited_for(under_way: deque[tuple[Future[int], int]]) -> int:
    """Wait for the first file, and return its number of frames."""
    written, frames = under_way.popleft()
    written.result()
    return frames


def _storing(work: Workload, encoder: EncoderOnDevice) -> Encode:
    def encode(inputs: Tensor) -> StoredLatents:
        return pack_latents(encoder.latents(inputs), work.writer.key.kind)

    return encode


def _write(work: Workload, one: Encoded) -> int:
    wanted = one.wanted
    encoded = EncodedEpisode(one.recording, wanted.camera, wanted.steps.tolist(), one.latents, one.small_frames)
    return work.writer.write_episode(wanted.episode, encoded)


def _leave_out(work: Workload, one: Unreadable) -> None:
    """Apply `data.broken_episodes`, and record the episode for the other processes."""
    work.dataset.leave_out(one.wanted.episode, one.error)
    name = work.dataset.table.identity(one.wanted.episode)
    note_broken(work.writer.folder, one.wanted.episode, name, str(one.error))


def frames_per_second(encoder: EncoderOnDevice) -> float:
    """Measure the encoding speed on a chunk of black frames, after a warm-up chunk where a device needs one."""
    size = encoder.world_model.image_size
    black = torch.zeros(encoder.chunk, 3, size, size, device=encoder.device)
    if encoder.device.type != "cpu":
        encoder.latents(black).cpu()
    started = time.perf_counter()
    encoder.latents(black).cpu()
    return encoder.chunk / (time.perf_counter() - started)
