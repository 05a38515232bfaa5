"""The clip loader: batches in a deterministic order.

The batch at a position of the run is a pure function of the seed and the position. Workers only affect the speed.
"""

from __future__ import annotations

import atexit
import itertools
import multiprocessing
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader
from torch.utils.data import Dataset as TorchDataset

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.clips.augmentation import draw
from vjepa2_ac.data.clips.clip_reader import ClipRequest, collate, no_clips, read_clip
from vjepa2_ac.data.clips.dataset import Dataset
from vjepa2_ac.data.clips.prefetch import Batches, MicroBatch
from vjepa2_ac.data.clips.streams import NO_COPIES, Copies
from vjepa2_ac.data.clips.windows import ClipOrder, far_neighbours, spread
from vjepa2_ac.data.clips.worker_processes import end_with_the_run, end_workers, start_servers_deaf
from vjepa2_ac.data.filters.exclusion import named, with_way_out
from vjepa2_ac.data.filters.step_ranges import drawn
from vjepa2_ac.episode import Batch, Clip, Skipped
from vjepa2_ac.errors import InputError, UserError

CLIPS_WORTH_WORKERS = 256  # starting workers takes longer than reading fewer validation clips


@dataclass(frozen=True)
class ProcessShare:
    """The index of a process among those that share some work."""

    rank: int = 0
    processes: int = 1


WHOLE = ProcessShare()


@dataclass(frozen=True)
class Mixed:
    """A data set, and a second one that a share of the training clips comes from."""

    dataset: Dataset
    replayed: Dataset
    share: float


def training_loader(
    dataset: Dataset | Mixed,
    *,
    seed: int,
    batch_size: int,
    start_position: int = 0,
    share: ProcessShare = WHOLE,
    copies: Copies = NO_COPIES,
) -> Batches:
    """Yield the micro-batches of one process, endlessly, from any position of the run.

    The run is one sequence of clips. Micro-batch m of rank r holds the `batch_size` clips from position
    start_position + (m * processes + r) * batch_size, so after m micro-batches of every rank the position to resume
    from is start_position + m * processes * batch_size. If `data.broken_episodes` is skip, clips that cannot be
    read are missing from their micro-batch, which may even be empty; no other clip replaces them.

    Of two data sets each has its own sequence. Clip p of the run is the second one's if floor(p * share) grows after
    it, and that number is its position there: the share is exact in every stretch of the run, up to a clip.

    If batches are prefetched to a device (`copies`), they are in pinned memory.

    Raises:
        InputError: There is nothing to train on, or a clip cannot be read, also in a worker.
    """
    if isinstance(dataset, Mixed):
        replayed, of_clips = _training_clips(dataset.replayed, seed), Fraction(str(dataset.share))
        clips = replace(_training_clips(dataset.dataset, seed), replayed=replayed, share=of_clips)
    else:
        clips = _training_clips(dataset, seed)
    firsts = itertools.count(start_position + share.rank * batch_size, batch_size * share.processes)
    rows = (list(range(first, first + batch_size)) for first in firsts)
    return _batches(clips, rows, clips.dataset.config.workers, copies)


def validation_batches(
    dataset: Dataset, split: Split, *, clips: int, batch_size: int, copies: Copies = NO_COPIES
) -> Iterator[Batch]:
    """Yield a fixed set of at most `clips` clips of a split, evenly spread over its windows, in batches.

    The set depends on the data only: neither the seed nor the number of shards changes it. Neighbours in it are from
    distant parts of the data, so that their actions are unrelated. A large set is read by workers.

    Raises:
        InputError: The split is empty, or a clip cannot be read.
    """
    return batches_of(dataset, validation_windows(dataset, split, clips=clips), batch_size=batch_size, copies=copies)


def validation_windows(dataset: Dataset, split: Split, *, clips: int) -> list[tuple[int, int]]:
    """Return the starts of those clips: (episode, first control step), in their order.

    Raises:
        InputError: The split is empty.
    """
    windows = dataset.windows(split)
    return [windows[index] for index in far_neighbours(spread(len(windows), clips))]


def batches_of(
    dataset: Dataset, windows: Sequence[tuple[int, int]], *, batch_size: int, copies: Copies = NO_COPIES
) -> Iterator[Batch]:
    """Yield the clips that start at these (episode, first control step), in this order, in batches.

    If `data.broken_episodes` is skip, a batch may be smaller; none is empty. Many clips are read by workers.

    Raises:
        InputError: A clip cannot be read; or, by policy, none of them.
    """
    count = len(windows)
    rows = [list(range(first, min(first + batch_size, count))) for first in range(0, count, batch_size)]
    workers = dataset.config.workers if count >= CLIPS_WORTH_WORKERS else 0
    clips = _Clips(dataset, partial(_chosen_clip, dataset, windows))
    return _some_of(_batches(clips, iter(rows), workers, copies), dataset)


def _some_of(batches: Iterator[Batch], dataset: Dataset) -> Iterator[Batch]:
    """Yield the batches that hold clips.

    Raises:
        InputError: None does.
    """
    empty = True
    for batch in batches:
        if batch.starts:
            empty = False
            yield batch
    if empty:
        raise InputError(
            where=f"data.path: {dataset.config.path}",
            found=f"none of the clips can be read; broken episodes: {named(tuple(dataset.broken.reasons))}",
            needed="at least one",
            fix="Repair or fetch these episodes again, or add them to data.exclude",
        )


def _training_clip(config: DataConfig, order: ClipOrder, position: int) -> ClipRequest:
    """Return a clip of the endless sequence of a run: camera and augmentation are drawn per clip."""
    camera = config.cameras[order.choice(position, len(config.cameras))]
    augmentation = partial(draw, config.augment, seed=order.seed, position=position)
    return ClipRequest(*order.window(position), camera, augmentation)


def _chosen_clip(dataset: Dataset, windows: Sequence[tuple[int, int]], position: int) -> ClipRequest:
    """Return a clip of a list of windows; the camera is drawn per window."""
    episode, start = windows[position]
    # Not the number by which idle windows were drawn: kept ones have a small number, and would share a camera.
    number = drawn(~dataset.table.id_hash[[episode]], np.array([start], np.int32))[0]
    cameras = dataset.config.cameras
    return ClipRequest(episode, start, cameras[int(number * len(cameras))])


@dataclass(frozen=True)
class _Clips(TorchDataset[MicroBatch]):
    """Clips by position, read a micro-batch at a time."""

    dataset: Dataset
    request_at: Callable[[int], ClipRequest]  # a pure function of the position, the same in every worker
    replayed: _Clips | None = None  # of the second data set
    share: Fraction = Fraction(0)  # of these

    def __getitems__(self, positions: list[int]) -> MicroBatch | UserError:
        """Return a micro-batch, or its error: DataLoader would change an error that is raised."""
        before = storage.bytes_fetched()
        try:
            read = self._read(positions)
            clips = [one for one in read if isinstance(one, Clip)]
            skipped = tuple(one for one in read if isinstance(one, Skipped))
            fetched = storage.bytes_fetched() - before
            if not clips:
                return MicroBatch(no_clips(self.dataset.config.frames, self.dataset.widths, fetched), skipped)
            return MicroBatch(collate(clips, fetched), skipped)
        except UserError as error:
            return error

    def _read(self, positions: list[int]) -> list[Clip | Skipped]:
        configs = [one.dataset.config for one in (self, self.replayed) if one is not None]
        if not any(storage.is_url(config.path) for config in configs):
            return [self._clip(position) for position in positions]
        with ThreadPoolExecutor(min(len(positions), *(config.connections for config in configs))) as pool:
            return list(pool.map(self._clip, positions))

    def _clip(self, position: int) -> Clip | Skipped:
        if self.replayed is not None:
            before, after = (int(number * self.share) for number in (position, position + 1))
            if after > before:
                clip = self.replayed._clip(before)
                return replace(clip, replayed=True) if isinstance(clip, Skipped) else clip
            position -= before
        request = self.request_at(position)
        try:
            return read_clip(self.dataset, request)
        except InputError as error:
            name = self.dataset.table.identity(request.episode)
            if self.dataset.config.broken_episodes == "error":
                raise with_way_out(error, [name]) from None
            return Skipped(name, str(error))


def _training_clips(dataset: Dataset, seed: int) -> _Clips:
    return _Clips(dataset, partial(_training_clip, dataset.config, ClipOrder(dataset.windows("train"), seed)))


def _batches(clips: _Clips, positions: Iterator[list[int]], workers: int, copies: Copies) -> Batches:
    rows, broken = _read(clips, positions, workers, pinned=copies.overlap), clips.dataset.broken
    replayed = broken if clips.replayed is None else clips.replayed.dataset.broken
    return Batches(rows, broken, copies, replayed)


def _read(
    clips: _Clips, positions: Iterator[list[int]], workers: int, *, pinned: bool
) -> Generator[MicroBatch | UserError, None, None]:
    # A fork server has no threads: a plain fork may hang in OpenMP or CUDA, and Python warns of it.
    context = multiprocessing.get_context("forkserver") if workers else None
    if context is not None:
        context.set_forkserver_preload([__name__])
        start_servers_deaf()
    loader = DataLoader(
        clips,
        batch_sampler=positions,
        collate_fn=_identity,
        generator=torch.Generator(),  # otherwise the loader uses dropout's generator
        num_workers=workers,
        multiprocessing_context=context,
        worker_init_fn=end_with_the_run if workers else None,
        prefetch_factor=clips.dataset.config.prefetch if workers else None,
        pin_memory=pinned,
    )
    others = set(multiprocessing.active_children())
    rows = iter(loader)
    ours = set(multiprocessing.active_children()) - others
    at_exit = partial(end_workers, ours)
    atexit.register(at_exit)  # multiprocessing sends SIGTERM, and waits for workers that ignore it
    try:
        yield from rows
    finally:
        del rows  # requests the workers to end, and waits for a while
        end_workers(ours)
        atexit.unregister(at_exit)


def _identity(batch: Any) -> Any:
    return batch
