"""The encoding pipeline: prefetched frames, encoded in chunks, written as one file per episode.

An episode is complete once its file has its final name: a process that is killed loses only the episodes in progress.
The process that finds nothing missing finalizes the cache.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.data.sources.latents.dtypes import pack_latents
from vjepa2_ac.data.sources.latents.episode_file import EncodedEpisode
from vjepa2_ac.data.sources.latents.manifest import Manifest
from vjepa2_ac.data.streams import copies_for
from vjepa2_ac.encoding.batching import Chunks, Encoded
from vjepa2_ac.encoding.disk_space import small_frame_side
from vjepa2_ac.encoding.prefetch import Unreadable, prefetched
from vjepa2_ac.encoding.workload import Workload, broken_in, forget_broken, note_broken
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.model.network.world_model import WorldModel

_WRITES_UNDER_WAY = 2  # files: limits the memory


@dataclass(frozen=True, eq=False)
class EncoderOnDevice:
    """The frozen encoder of a model on its device, and its settings."""

    world_model: WorldModel
    device: torch.device
    autocast: Callable[[], contextlib.AbstractContextManager[object]]
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
    if work.left:
        for done in itertools.accumulate(_written(work, encoder, threads), initial=0):
            progress(done, work.frames_left)
    if work.is_incomplete:
        return None
    broken = broken_in(folder)
    for name, reason in broken.items():
        dataset.broken.met(name, reason)  # of the other processes, too: together they may be too many
    return work.writer.finish(dataset, broken=broken, frames=work.frames)


def _written(work: Workload, encoder: EncoderOnDevice, threads: int) -> Iterator[int]:
    """Write episode after episode; yield the number of frames of each one, also of an unreadable one."""
    image_size, kind = encoder.world_model.image_size, work.writer.key.kind
    chunks = Chunks(
        lambda inputs: pack_latents(encoder.latents(inputs), kind),
        chunk=encoder.chunk,
        image_size=image_size,
        copies=copies_for(encoder.device),
    )
    under_way = deque[Future[int]]()
    decoded = prefetched(work.dataset, work.left, threads=threads, side=small_frame_side(image_size))
    with contextlib.closing(decoded), ThreadPoolExecutor(1, thread_name_prefix="write") as pool:
        for one in chunks.encoded(decoded):
            if isinstance(one, Unreadable):
                _leave_out(work, one)
                yield len(one.wanted.steps)
            else:
                under_way.append(pool.submit(_write, work, one))
            while len(under_way) > _WRITES_UNDER_WAY or (under_way and under_way[0].done()):
                yield under_way.popleft().result()
        for written in under_way:
            yield written.result()


def _write(work: Workload, one: Encoded) -> int:
    """Write the file of an episode, and return its number of frames."""
    wanted, steps = one.wanted, one.wanted.steps.tolist()
    encoded = EncodedEpisode(one.recording, wanted.camera, steps, one.latents, one.small_frames)
    work.writer.write_episode(wanted.episode, encoded)
    return len(steps)


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
