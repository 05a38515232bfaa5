"""The clip loader: batches in a deterministic order.

The batch at a position of the run is a pure function of the seed and the position. Workers only affect the speed.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial

from torch.utils.data import Dataset as TorchDataset

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.clips import ClipRequest, collate, no_clips
from vjepa2_ac.data.dataset import Dataset, read_clip
from vjepa2_ac.data.files import connections_to, in_parallel
from vjepa2_ac.data.selection import BrokenEpisodes, named
from vjepa2_ac.data.streams import in_shared_memory, in_worker, results_of_workers
from vjepa2_ac.data.transforms import ClipChanges
from vjepa2_ac.data.windows import ClipOrder, far_neighbours, spread
from vjepa2_ac.episode import Batch, Clip, Skipped
from vjepa2_ac.errors import InputError, UserError

CLIPS_WORTH_WORKERS = 256  # starting workers takes longer than reading fewer validation clips


@dataclass(frozen=True)
class ProcessShare:
    """The index of a process among those that share some work."""

    rank: int = 0
    processes: int = 1
    of_step: int | None = None  # micro-batches of an optimizer step, of all processes; None: one per process

    @property
    def own(self) -> range:
        """The micro-batches of a step that this process computes: every n-th, for n processes."""
        return range(self.rank, self.processes if self.of_step is None else self.of_step, self.processes)


WHOLE = ProcessShare()


@dataclass(frozen=True)
class Mixed:
    """A data set, and a second one that a share of the training clips comes from."""

    dataset: Dataset
    replayed: Dataset | None = None
    share: float = 0.0


def training_loader(
    dataset: Dataset | Mixed,
    *,
    seed: int,
    batch_size: int,
    start_position: int = 0,
    share: ProcessShare = WHOLE,
    pinned: bool = False,
) -> Batches:
    """Yield the micro-batches of one process, endlessly, from any position of the run.

    The run is one sequence of clips. Micro-batch m of it holds the `batch_size` clips from position
    start_position + m * batch_size; the process has its own of each step. If `data.broken_episodes` is skip, clips that
    cannot be read are missing from their micro-batch, which may even be empty; no other clip replaces them.

    Each of two data sets has a sequence of its own. Clip p of the run is clip floor(p * share) of the second data set
    if floor((p + 1) * share) is larger than floor(p * share). So the share is exact in every part of the run, up to a
    clip.

    Pinned batches are in memory from which copies to a CUDA device do not block the host.

    Raises:
        InputError: There is nothing to train on, or a clip cannot be read, also in a worker.
    """
    both = dataset if isinstance(dataset, Mixed) else Mixed(dataset)
    dataset, replayed = both.dataset, both.replayed
    clips = _training_clips(dataset, seed)
    if replayed is not None:
        clips = replace(clips, replayed=_training_clips(replayed, seed), share=Fraction(str(both.share)))
    firsts = first_clips(share, batch_size, start=start_position)
    rows = (list(range(first, first + batch_size)) for first in firsts)
    micro_batches = results_of_workers(clips, rows, dataset.config.workers, pinned=pinned)
    return Batches(micro_batches, dataset.broken, replayed.broken if replayed else None)


def first_clips(share: ProcessShare, batch_size: int, *, start: int) -> Iterator[int]:
    """Yield the position of the first clip of each micro-batch of a process, endlessly."""
    for before in itertools.count(0, share.of_step or share.processes):
        yield from (start + (before + number) * batch_size for number in share.own)


def _training_clips(dataset: Dataset, seed: int) -> _MicroBatches:
    order = ClipOrder(dataset.windows("train"), seed)
    return _MicroBatches(dataset, partial(_training_clip, dataset.config, order), ClipChanges.of(dataset.config, seed))


def _training_clip(config: DataConfig, order: ClipOrder, position: int) -> ClipRequest:
    """Return the request for a clip of the endless sequence of a run: the camera is drawn per clip."""
    camera = config.cameras[order.choice(position, len(config.cameras))]
    return ClipRequest(*order.window(position), camera)


def validation_batches(dataset: Dataset, split: Split, *, clips: int, batch_size: int) -> Iterator[Batch]:
    """Yield a fixed set of at most `clips` clips of a split, evenly spread over its windows, in batches.

    The set depends on the data only: neither the seed nor the number of shards changes it. Neighbours in it are from
    distant parts of the data, so that their actions are unrelated. A large set is read by workers.

    Raises:
        InputError: The split is empty, or a clip cannot be read.
    """
    return batches_of(dataset, validation_windows(dataset, split, clips=clips), batch_size=batch_size)


def validation_windows(dataset: Dataset, split: Split, *, clips: int) -> list[tuple[int, int]]:
    """Return the windows of the clips of `validation_batches`, in order: (episode, first control step).

    Raises:
        InputError: The split is empty.
    """
    windows = dataset.windows(split)
    return [windows[index] for index in far_neighbours(spread(len(windows), clips))]


def batches_of(
    dataset: Dataset, windows: Sequence[tuple[int, int]], *, batch_size: int, may_be_none: bool = False
) -> Iterator[Batch]:
    """Yield the clips that start at these (episode, first control step), in this order, in batches.

    If `data.broken_episodes` is skip, a batch may be smaller; none is empty. Many clips are read by workers.

    Raises:
        InputError: A clip cannot be read; or, by policy, none of them, unless that may be.
    """
    count, empty = len(windows), not may_be_none
    rows = [list(range(first, min(first + batch_size, count))) for first in range(0, count, batch_size)]
    workers = dataset.config.workers if count >= CLIPS_WORTH_WORKERS else 0
    clips = _MicroBatches(dataset, partial(_chosen_clip, dataset, windows))
    for batch in Batches(results_of_workers(clips, iter(rows), workers), dataset.broken):
        if batch.starts:
            empty = False
            yield batch
    if empty:
        found = f"none of the clips can be read; broken episodes: {named(tuple(dataset.broken.reasons))}"
        fix = "Repair or fetch these episodes again, or add them to data.exclude"
        raise InputError(where=f"data.path: {dataset.config.path}", found=found, fix=fix)


def _chosen_clip(dataset: Dataset, windows: Sequence[tuple[int, int]], position: int) -> ClipRequest:
    return dataset.request(windows[position])


@dataclass(frozen=True)
class _MicroBatches(TorchDataset[Batch]):
    """Micro-batches of the clips at given positions."""

    dataset: Dataset
    request_at: Callable[[int], ClipRequest]  # a pure function of the position, the same in every worker
    changes: ClipChanges | None = None  # of training clips; likewise
    replayed: _MicroBatches | None = None  # of the second data set
    share: Fraction = Fraction(0)  # of these

    def __getitems__(self, positions: list[int]) -> Batch | UserError:
        """Return a micro-batch, or its error: DataLoader would change an error that is raised.

        A worker puts the batch into shared memory here: PyTorch would do so in a thread, whose error gets lost.
        """
        before = storage.bytes_fetched()
        try:
            read = self._read(positions)
            clips = [one for one in read if isinstance(one, Clip)]
            skipped = tuple(one for one in read if isinstance(one, Skipped))
            batch = collate(clips) if clips else no_clips(self.dataset.config.frames, self.dataset.widths)
            batch = replace(batch, bytes_fetched=storage.bytes_fetched() - before, skipped=skipped)
            return in_shared_memory(batch) if in_worker() else batch
        except UserError as error:
            return error

    def _read(self, positions: list[int]) -> list[Clip | Skipped]:
        data_sets = [one.dataset for one in (self, self.replayed) if one is not None]
        return list(in_parallel(self._clip, positions, max(connections_to(one.config) for one in data_sets)))

    def _clip(self, position: int) -> Clip | Skipped:
        if self.replayed is not None:
            before, after = (int(number * self.share) for number in (position, position + 1))
            if after > before:
                clip = self.replayed._clip(before)
                return replace(clip, replayed=True) if isinstance(clip, Skipped) else clip
            position -= before
        request = self.request_at(position)
        try:
            clip = read_clip(self.dataset, request)
        except InputError as error:
            name = self.dataset.table.identity(request.episode)
            if self.dataset.config.broken_episodes == "error":
                raise self.dataset.broken.refusal(error, [name]) from None
            return Skipped(name, str(error))
        return clip if self.changes is None else self.changes.apply(clip, position)


class Batches(Iterator[Batch]):
    """The batches of a loader, in order; a batch's error and its skipped clips are reported when it is requested.

    Args:
        rows: The workers' results: micro-batches, or errors instead.
        broken: Records clips that could not be read.
        replayed: Records those of the second data set.
    """

    def __init__(
        self,
        rows: Generator[Batch | UserError, None, None],
        broken: BrokenEpisodes,
        replayed: BrokenEpisodes | None = None,
    ) -> None:
        self._rows, self._broken, self._replayed = rows, broken, replayed

    def __next__(self) -> Batch:
        """Return the next batch.

        Raises:
            InputError: A clip cannot be read, also in a worker; or too many cannot.
        """
        row = next(self._rows)
        if isinstance(row, UserError):
            self.close()
            raise row
        for one in row.skipped:
            broken = self._replayed if one.replayed and self._replayed is not None else self._broken
            broken.met(one.episode_id, one.reason)
        return row

    def close(self) -> None:
        """End the workers."""
        self._rows.close()
