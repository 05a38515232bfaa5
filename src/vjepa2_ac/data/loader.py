"""How do clips become batches, in an order that nothing can disturb?

The batch at a place of the run is a pure function of the seed and that place. Workers only decide how soon it is there.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.exclusion import with_way_out
from vjepa2_ac.data.sources.rlds import RldsSource
from vjepa2_ac.data.transforms import crop
from vjepa2_ac.data.windows import ClipOrder, Split, far_neighbours, spread, windows_of
from vjepa2_ac.episode import Batch, Clip, EpisodeSource
from vjepa2_ac.errors import InputError
from vjepa2_ac.geometry import actions_from_states

_PREFETCHED_BATCHES = 2


def open_source(config: DataConfig) -> EpisodeSource:
    """Return the source that `data.source` names; nothing is read yet."""
    return {"rlds": RldsSource}[config.source](config)


def clip_at(source: EpisodeSource, episode: int, start: int, config: DataConfig) -> Clip:
    """Return the clip that starts at a control step of an episode; decodes its frames only.

    Raises:
        InputError: The episode or one of the pictures cannot be read; says how to leave the episode out.
    """
    steps = range(start, start + config.clip_steps, config.stride)
    try:
        recording = source.read(episode)
        frames = recording.read_frames(steps)
    except InputError as error:
        raise with_way_out(error, [source.infos()[episode].id]) from None
    states = recording.states[steps.start : steps.stop : steps.step]
    extrinsics = recording.extrinsics
    return Clip(
        frames=crop(frames),
        states=states.astype(np.float32),
        actions=actions_from_states(states).astype(np.float32),
        extrinsics=None if extrinsics is None else extrinsics[list(steps)].astype(np.float32),
        episode_id=recording.info.id,
        start=start,
        stride=config.stride,
    )


def collate(clips: Sequence[Clip]) -> Batch:
    """Stack clips into a batch.

    Raises:
        InputError: The pictures of two clips differ in size.
    """
    first = clips[0]
    for clip in clips:
        if clip.frames.shape != first.frames.shape:
            error = InputError(
                where=f"episode {clip.episode_id}",
                found=f"pictures of {'x'.join(map(str, clip.frames.shape[1:3]))} after the crop",
                needed=f"{'x'.join(map(str, first.frames.shape[1:3]))}, as in episode {first.episode_id}",
                fix="Train on episodes of one size, or set training.batch_size: 1",
            )
            raise with_way_out(error, [clip.episode_id])
    extrinsics = [clip.extrinsics for clip in clips if clip.extrinsics is not None]
    return Batch(
        frames=torch.from_numpy(np.stack([clip.frames for clip in clips])),
        states=torch.from_numpy(np.stack([clip.states for clip in clips])),
        actions=torch.from_numpy(np.stack([clip.actions for clip in clips])),
        extrinsics=torch.from_numpy(np.stack(extrinsics)) if extrinsics else None,
        episode_ids=tuple(clip.episode_id for clip in clips),
        starts=tuple(clip.start for clip in clips),
    )


def training_loader(
    source: EpisodeSource,
    config: DataConfig,
    *,
    seed: int,
    batch_size: int,
    start_position: int = 0,
    rank: int = 0,
    world_size: int = 1,
) -> Iterator[Batch]:
    """Yield the micro-batches of one rank, without end, from any position of the run at once.

    The run is one row of clips. Micro-batch m of rank r holds the `batch_size` clips from position
    start_position + (m * world_size + r) * batch_size, so after m micro-batches of every rank the position to resume
    from is start_position + m * world_size * batch_size.

    Raises:
        InputError: There is nothing to train on, or a clip cannot be read, also where a worker met it.
    """
    order = ClipOrder(windows_of(source.infos(), config, "train"), seed)
    clips = _Clips(source, config, order)
    return _batches(
        clips, _rows(start_position + rank * batch_size, batch_size, batch_size * world_size), config.workers
    )


def validation_batches(
    source: EpisodeSource, config: DataConfig, split: Split, *, clips: int, batch_size: int
) -> Iterator[Batch]:
    """Yield a fixed set of at most `clips` clips of a split, evenly spread over its windows, in this process.

    The set follows from the data alone: neither the seed nor the number of shards changes it. Neighbours in it are
    from far apart, so that the actions of one are no stand-in for those of the next.

    Raises:
        InputError: The split is empty, or a clip cannot be read.
    """
    windows = windows_of(source.infos(), config, split)
    chosen = [windows[index] for index in far_neighbours(spread(len(windows), clips))]

    def batches() -> Iterator[Batch]:
        for first in range(0, len(chosen), batch_size):
            row = chosen[first : first + batch_size]
            yield collate([clip_at(source, episode, start, config) for episode, start in row])

    return batches()


@dataclass(frozen=True)
class _Clips(Dataset[Batch]):
    """The clips of a run by position, read a batch at a time."""

    source: EpisodeSource
    config: DataConfig
    order: ClipOrder

    def __getitems__(self, positions: list[int]) -> Batch | InputError:
        """Return a batch, or the error that prevents it: DataLoader could not carry that one home unharmed."""
        try:
            return collate([clip_at(self.source, *self.order.window(position), self.config) for position in positions])
        except InputError as error:
            return error


def _rows(first: int, length: int, distance: int) -> Iterator[list[int]]:
    for start in itertools.count(first, distance):
        yield list(range(start, start + length))


def _batches(clips: _Clips, positions: Iterator[list[int]], workers: int) -> Iterator[Batch]:
    # A fork server has no threads: a plain fork may hang in OpenMP or CUDA, and Python warns of it.
    context = multiprocessing.get_context("forkserver") if workers else None
    if context is not None:
        context.set_forkserver_preload([__name__])
    loader = DataLoader(
        clips,
        batch_sampler=positions,
        collate_fn=_as_it_is,
        generator=torch.Generator(),  # else the loader draws from the generator that dropout draws from
        num_workers=workers,
        multiprocessing_context=context,
        worker_init_fn=_end_with_the_run if workers else None,
        prefetch_factor=_PREFETCHED_BATCHES if workers else None,
    )
    for batch in loader:
        if isinstance(batch, InputError):
            raise batch
        yield batch


def _end_with_the_run(_worker: int) -> None:
    """End this worker when the process that reads from it is gone, however it went.

    PyTorch's own watch looks at the fork server, which lives as long as its workers: both would stay for ever.
    """
    run = multiprocessing.parent_process()
    if run is None:
        raise ValueError("not in a worker")

    def watch() -> None:
        run.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _as_it_is(batch: Any) -> Any:
    return batch
