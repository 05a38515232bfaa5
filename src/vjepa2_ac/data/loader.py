"""The clip loader: batches in a deterministic order.

The batch at a position of the run is a pure function of the seed and the position. Workers affect only the speed; they
send batches through shared memory. A run never waits forever for a worker: it ends if a worker dies, cannot send a
batch, or does not deliver a batch within a few seconds of a stop signal.
"""

from __future__ import annotations

import atexit
import itertools
import math
import multiprocessing
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from multiprocessing import forkserver, queues, resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, get_worker_info
from torch.utils.data import Dataset as TorchDataset

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.clips import ClipRequest, collate, empty_batch
from vjepa2_ac.data.dataset import Dataset, read_clip
from vjepa2_ac.data.files import map_in_threads, num_connections
from vjepa2_ac.data.selection import BrokenEpisodes, format_identities
from vjepa2_ac.data.transforms import ClipTransforms
from vjepa2_ac.data.windows import ClipOrder, interleave_halves, spread_indices
from vjepa2_ac.episode import Batch, Clip, SkippedClip
from vjepa2_ac.errors import InputError, UnreachableError, UserError, counted
from vjepa2_ac.process import safe_imports, stop_request

SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - PyTorch stores the batches of workers here on Linux
PREFETCH = 2  # batches that each worker prepares in advance
_POLL_S = 1.0  # interval of checks of workers and signals while waiting for a batch
_GRACE_S = 5.0  # time limit for a batch after a stop signal, so that the step can be finished
_NO_WORKERS = "data.workers=0"
_MORE_SHARED_MEMORY = f"In Docker, add --shm-size=8g or --ipc=host to `docker run`. Otherwise set {_NO_WORKERS}"
MIN_CLIPS_FOR_WORKERS = 256  # starting workers takes longer than reading fewer validation clips


@dataclass(frozen=True)
class ProcessShare:
    """The share of one process in work that is split between several processes."""

    rank: int = 0
    processes: int = 1
    micro_batches_per_step: int | None = None  # of all processes together, per optimizer step; None: one per process

    @property
    def micro_batches(self) -> range:
        """The indices of the micro-batches of a step that this process computes: rank, rank + processes, ..."""
        return range(self.rank, self.micro_batches_per_step or self.processes, self.processes)


SINGLE_PROCESS = ProcessShare()


@dataclass(frozen=True)
class MixedDataset:
    """A data set, and optionally a second data set that provides a fraction of the training clips (replay)."""

    dataset: Dataset
    replayed: Dataset | None = None
    replay_share: float = 0.0  # fraction of the clips that are from `replayed`


def training_loader(
    dataset: Dataset | MixedDataset,
    *,
    seed: int,
    batch_size: int,
    start_position: int = 0,
    share: ProcessShare = SINGLE_PROCESS,
    pinned: bool = False,
) -> Batches:
    """Yield the micro-batches of one process, endlessly, from any position of the run.

    The run is one sequence of clips. Micro-batch m holds the `batch_size` clips from position
    start_position + m * batch_size, and the micro-batches of a step are split between the processes. If
    `data.broken_episodes` is skip, clips that cannot be read are missing from their micro-batch, which may be empty;
    no other clip replaces them.

    With a second data set, each data set has a separate sequence. With the fraction f = `MixedDataset.replay_share`,
    clip p of the run is clip floor(p * f) of the second data set if floor((p + 1) * f) is larger than floor(p * f). The
    fraction is therefore exact, up to one clip, in every part of the run.

    Pinned batches are in page-locked memory, from which copies to a CUDA device do not block the host.

    Raises:
        InputError: There are no training clips, or a clip cannot be read, here or in a worker.
    """
    mixed = dataset if isinstance(dataset, MixedDataset) else MixedDataset(dataset)
    dataset, replayed = mixed.dataset, mixed.replayed
    clips = _training_clips(dataset, seed)
    if replayed is not None:
        clips = replace(clips, replayed=_training_clips(replayed, seed), replay_share=Fraction(str(mixed.replay_share)))
    firsts = first_positions(share, batch_size, start=start_position)
    positions = (list(range(first, first + batch_size)) for first in firsts)
    micro_batches = map_in_workers(clips, positions, dataset.config.workers, pinned=pinned)
    return Batches(micro_batches, dataset.broken, replayed.broken if replayed else None)


def first_positions(share: ProcessShare, batch_size: int, *, start: int) -> Iterator[int]:
    """Yield the position of the first clip of each micro-batch of a process, endlessly."""
    for first_of_step in itertools.count(0, share.micro_batches_per_step or share.processes):
        yield from (start + (first_of_step + number) * batch_size for number in share.micro_batches)


def _training_clips(dataset: Dataset, seed: int) -> _MicroBatches:
    order = ClipOrder(dataset.windows("train"), seed)
    return _MicroBatches(
        dataset, partial(_training_clip, dataset.config, order), ClipTransforms.from_config(dataset.config, seed)
    )


def _training_clip(config: DataConfig, order: ClipOrder, position: int) -> ClipRequest:
    """Return the request for the clip at a position of the endless sequence; the camera is drawn per clip."""
    camera = config.cameras[order.draw_index(position, len(config.cameras))]
    return ClipRequest(*order.window(position), camera)


def validation_batches(dataset: Dataset, split: Split, *, clips: int, batch_size: int) -> Iterator[Batch]:
    """Yield a fixed set of at most `clips` clips of a split, evenly spread over its windows, in batches.

    The set depends on the data only, not on the seed or the number of shards. Consecutive clips are from distant parts
    of the data, so that their actions are unrelated. A large set is read by workers.

    Raises:
        InputError: The split is empty, or a clip cannot be read.
    """
    return read_batches(dataset, validation_windows(dataset, split, clips=clips), batch_size=batch_size)


def validation_windows(dataset: Dataset, split: Split, *, clips: int) -> list[tuple[int, int]]:
    """Return the windows of the clips of `validation_batches`, in order: (episode, first control step).

    Raises:
        InputError: The split is empty.
    """
    windows = dataset.windows(split)
    return [windows[index] for index in interleave_halves(spread_indices(len(windows), clips))]


def read_batches(
    dataset: Dataset, windows: Sequence[tuple[int, int]], *, batch_size: int, allow_empty: bool = False
) -> Iterator[Batch]:
    """Yield batches of the clips at these windows (episode, first control step), in order.

    If `data.broken_episodes` is skip, a batch may be smaller, but never empty. Many clips are read by workers.

    Raises:
        InputError: A clip cannot be read; or all clips were skipped and `allow_empty` is False.
    """
    count, is_empty = len(windows), True
    positions = [list(range(first, min(first + batch_size, count))) for first in range(0, count, batch_size)]
    workers = dataset.config.workers if count >= MIN_CLIPS_FOR_WORKERS else 0
    clips = _MicroBatches(dataset, partial(_window_request, dataset, windows))
    for batch in Batches(map_in_workers(clips, iter(positions), workers), dataset.broken):
        if batch.starts:
            is_empty = False
            yield batch
    if is_empty and not allow_empty:
        problem = f"none of the clips can be read; broken episodes: {format_identities(tuple(dataset.broken.reasons))}"
        fix = "Repair or fetch these episodes again, or add them to data.exclude"
        raise InputError(where=f"data.path: {dataset.config.path}", found=problem, fix=fix)


def _window_request(dataset: Dataset, windows: Sequence[tuple[int, int]], position: int) -> ClipRequest:
    return dataset.clip_request(windows[position])


@dataclass(frozen=True)
class _MicroBatches(TorchDataset[Batch]):
    """Micro-batches of clips, indexed by lists of positions."""

    dataset: Dataset
    request_at: Callable[[int], ClipRequest]  # a pure function of the position, the same in every worker
    transforms: ClipTransforms | None = None  # of training clips; also pure functions of the position
    replayed: _MicroBatches | None = None  # clips of the second data set
    replay_share: Fraction = Fraction(0)  # fraction of clips from the second data set

    def __getitems__(self, positions: list[int]) -> Batch | UserError:
        """Return a micro-batch, or the error of reading it, because DataLoader would change the type of a raised error.

        A worker moves the batch into shared memory here. PyTorch would move it in the sending thread, whose errors
        are lost.
        """
        before = storage.bytes_fetched()
        try:
            results = self._read(positions)
            clips = [result for result in results if isinstance(result, Clip)]
            skipped = tuple(result for result in results if isinstance(result, SkippedClip))
            batch = collate(clips) if clips else empty_batch(self.dataset.config.frames, self.dataset.widths)
            batch = replace(batch, bytes_fetched=storage.bytes_fetched() - before, skipped=skipped)
            return batch if get_worker_info() is None else _move_to_shared_memory(batch)
        except UserError as error:
            return error

    def _read(self, positions: list[int]) -> list[Clip | SkippedClip]:
        datasets = [clips.dataset for clips in (self, self.replayed) if clips is not None]
        connections = max(num_connections(dataset.config) for dataset in datasets)
        return list(map_in_threads(self._read_clip, positions, connections))

    def _read_clip(self, position: int) -> Clip | SkippedClip:
        if self.replayed is not None:
            num_replayed_before, num_replayed = (int(count * self.replay_share) for count in (position, position + 1))
            if num_replayed > num_replayed_before:
                clip = self.replayed._read_clip(num_replayed_before)
                return replace(clip, replayed=True) if isinstance(clip, SkippedClip) else clip
            position -= num_replayed_before
        request = self.request_at(position)
        try:
            clip = read_clip(self.dataset, request)
        except InputError as error:
            name = self.dataset.table.identity(request.episode)
            if self.dataset.config.broken_episodes == "error":
                raise self.dataset.broken.add_fix(error, [name]) from None
            return SkippedClip(name, str(error))
        return clip if self.transforms is None else self.transforms.apply(clip, position)


class Batches(Iterator[Batch]):
    """The batches of a loader, in order. The errors and skipped clips of a batch are reported when it is requested.

    Args:
        results: The results of the workers: micro-batches or errors.
        broken: Records clips that could not be read.
        replayed: Records clips of the second data set that could not be read.
    """

    def __init__(
        self,
        results: Generator[Batch | UserError, None, None],
        broken: BrokenEpisodes,
        replayed: BrokenEpisodes | None = None,
    ) -> None:
        self._results, self._broken, self._replayed = results, broken, replayed

    def __next__(self) -> Batch:
        """Return the next batch.

        Raises:
            InputError: A clip cannot be read, here or in a worker; or too many episodes are broken.
        """
        result = next(self._results)
        if isinstance(result, UserError):
            self.close()
            raise result
        for clip in result.skipped:
            broken = self._replayed if clip.replayed and self._replayed is not None else self._broken
            broken.record(clip.episode_id, clip.reason)
        return result

    def close(self) -> None:
        """End the workers."""
        self._results.close()


# ---- worker processes ----


def map_in_workers(
    items: TorchDataset[Any], positions: Iterator[list[int]], workers: int, *, pinned: bool = False
) -> Generator[Any, None, None]:
    """Yield `items.__getitems__(list)` for each list of positions, in order, computed by worker processes.

    Args:
        items: The data set.
        positions: The list of positions of each result.
        workers: Number of worker processes; 0: compute in this process.
        pinned: Put tensors into pinned memory.

    Raises:
        UnreachableError: A worker has ended, or no result arrived shortly after a stop signal.
    """
    # Workers are forked from a server without threads, because a fork of this process may hang in OpenMP or CUDA.
    context = multiprocessing.get_context("forkserver") if workers else None
    if context is not None:
        context.set_forkserver_preload(["vjepa2_ac.data.loader"])
        _start_servers()
    loader = DataLoader(
        items,
        batch_sampler=positions,
        collate_fn=_identity,
        generator=torch.Generator(),  # leaves the default generator, which dropout uses, unchanged
        num_workers=workers,
        multiprocessing_context=context,
        worker_init_fn=_prepare_worker if workers else None,
        timeout=_POLL_S if workers else 0,
        prefetch_factor=PREFETCH if workers else None,
        pin_memory=pinned,
    )
    other_children = set(multiprocessing.active_children())
    results = iter(loader)
    worker_processes = set(multiprocessing.active_children()) - other_children
    at_exit = partial(_end_workers, worker_processes)
    atexit.register(at_exit)  # multiprocessing would send SIGTERM and wait for workers that ignore it
    try:
        while (result := _next_result(results, worker_processes)) is not None:
            yield result
    finally:
        del results  # PyTorch requests the workers to end, and waits for them for a limited time
        _end_workers(worker_processes)
        atexit.unregister(at_exit)


def _identity(batch: Any) -> Any:
    return batch


def _next_result(results: Iterator[Any], workers: Iterable[BaseProcess]) -> Any:
    """Return the next result, or None at the end; raises the errors of `map_in_workers`."""
    started = time.monotonic()
    while True:
        try:
            return next(results, None)
        except RuntimeError as error:
            if dead := [worker for worker in workers if not worker.is_alive()]:
                problem = f"a loader worker has ended unexpectedly (exit code {dead[0].exitcode})"
                fix = f"If memory is full, lower data.workers. With {_NO_WORKERS} the main process reads the clips"
                raise UnreachableError(where="data.workers", found=problem, fix=fix) from error
            if "timed out" not in str(error):
                raise
        stop = stop_request()
        if min(stop.age_s, time.monotonic() - started) > _GRACE_S:
            raise UnreachableError(
                where="data",
                found=f"no batch arrived after {stop.reason}",
                needed=f"a batch within {_GRACE_S:.0f} s",
                fix="Run the same command again to resume from the newest checkpoint",
            )


def _end_workers(workers: Iterable[BaseProcess]) -> None:
    """Kill workers that did not end on request, because they are reading a clip and ignore SIGTERM."""
    for worker in workers:
        if worker.is_alive():
            worker.kill()


def _start_servers() -> None:
    """Start the fork server with safe imports and with stop signals blocked; its workers inherit the signal mask.

    A signal to the whole process group, as from a terminal, `timeout` or Slurm, must reach only the run, which needs
    its workers to finish the step and then ends them.
    """
    stop_signals = {signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP}
    for start in (resource_tracker.ensure_running, forkserver.ensure_running):  # the tracker unblocks the signals
        previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, stop_signals)
        try:
            with safe_imports():
                start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


# ---- in a worker ----


def _prepare_worker(_worker: int) -> None:
    """Make this worker exit when its run has ended for any reason, or when a batch cannot be sent.

    PyTorch's watchdog ends a worker when its parent ends. The parent is the fork server, which itself waits for the
    workers, so neither would exit after the run. The thread that sends batches only prints its errors, so the run would
    wait for the batch forever.
    """
    queues.Queue._on_queue_feeder_error = staticmethod(_end_without_sending)  # type: ignore[attr-defined]  # untyped
    run_process = multiprocessing.parent_process()
    if run_process is None:
        raise ValueError("not in a worker")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run handles Ctrl-C and ends its workers

    def watch() -> None:
        run_process.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _end_without_sending(error: BaseException, _batch: object) -> None:
    sys.stderr.write(f"A loader worker cannot send a batch: {type(error).__name__}: {error}\n")
    os._exit(1)


# ---- shared memory ----


def require_shared_memory(data: DataConfig, batch_bytes: float, processes: int = 1) -> None:
    """Check that shared memory has space for the prefetched batches of all workers; containers have 64 MB by default.

    Args:
        data: The config, which has the number of workers.
        batch_bytes: Size of a batch in bytes.
        processes: Number of processes of the run on this machine.

    Raises:
        UnreachableError: There is too little shared memory.
    """
    needed = processes * data.workers * PREFETCH * batch_bytes
    free = shutil.disk_usage(SHARED_MEMORY).free if SHARED_MEMORY.is_dir() else math.inf
    if needed > free:
        workers = counted(processes * data.workers, "worker")
        required = f"{_format_mb(needed)} for {workers} x {PREFETCH} prefetched batches of {_format_mb(batch_bytes)}"
        raise UnreachableError(
            where=str(SHARED_MEMORY), found=f"{_format_mb(free)} free", needed=required, fix=_MORE_SHARED_MEMORY
        )


def _move_to_shared_memory(batch: Batch) -> Batch:
    """Move the tensors of a batch into shared memory.

    Raises:
        UnreachableError: There is too little shared memory.
    """
    try:
        return batch.map_tensors(Tensor.share_memory_)
    except RuntimeError as error:
        problem = f"not enough space for a batch of {_format_mb(batch.nbytes)} from a loader worker ({error})"
        raise UnreachableError(where=str(SHARED_MEMORY), found=problem, fix=_MORE_SHARED_MEMORY) from None


def _format_mb(size: float) -> str:
    return f"{size / 1e6:.3g} MB"
