"""How batches come: from worker processes, through shared memory.

A worker never makes its run wait for ever: one that dies, cannot send, or is waited for after a signal ends the run.
"""

from __future__ import annotations

import atexit
import math
import multiprocessing
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Generator, Iterable, Iterator
from functools import partial
from multiprocessing import forkserver, queues, resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, get_worker_info
from torch.utils.data import Dataset as TorchDataset

from vjepa2_ac.config import DataConfig
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import UnreachableError, counted
from vjepa2_ac.process import safe_imports, stop_request

SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - where PyTorch puts the batches of workers, on Linux
PREFETCH = 2  # batches that each worker prepares in advance
_POLL_S = 1.0  # between two checks of workers and signals, while waiting for a batch
_GRACE_S = 5.0  # a signal waits this long for a batch, for the step to be finished
_NO_WORKERS = "data.workers=0"
_ROOM = f"With Docker add --shm-size=8g or --ipc=host to `docker run`, set {_NO_WORKERS}"


def results_of_workers(
    items: TorchDataset[Any], positions: Iterator[list[int]], workers: int, *, pinned: bool = False
) -> Generator[Any, None, None]:
    """Yield `items.__getitems__` of each list of positions, in order, computed by worker processes.

    Args:
        items: The data set.
        positions: What each result is made of.
        workers: Number of processes; 0: this one.
        pinned: Put tensors into pinned memory.

    Raises:
        UnreachableError: A worker has ended; or a signal has come, and no result soon after.
    """
    # A fork server has no threads: a plain fork may hang in OpenMP or CUDA, and Python warns of it.
    context = multiprocessing.get_context("forkserver") if workers else None
    if context is not None:
        context.set_forkserver_preload(["vjepa2_ac.data.loader"])
        _start_servers()
    loader = DataLoader(
        items,
        batch_sampler=positions,
        collate_fn=_identity,
        generator=torch.Generator(),  # otherwise the loader uses dropout's generator
        num_workers=workers,
        multiprocessing_context=context,
        worker_init_fn=_prepare_worker if workers else None,
        timeout=_POLL_S if workers else 0,
        prefetch_factor=PREFETCH if workers else None,
        pin_memory=pinned,
    )
    others = set(multiprocessing.active_children())
    rows = iter(loader)
    ours = set(multiprocessing.active_children()) - others
    at_exit = partial(_end_workers, ours)
    atexit.register(at_exit)  # multiprocessing sends SIGTERM, and waits for workers that ignore it
    try:
        while (row := _next_row(rows, ours)) is not None:
            yield row
    finally:
        del rows  # requests the workers to end, and waits for a while
        _end_workers(ours)
        atexit.unregister(at_exit)


def _identity(batch: Any) -> Any:
    return batch


def _next_row(rows: Iterator[Any], workers: Iterable[BaseProcess]) -> Any:
    """Return the next result; None: there is none. Errors as of `results_of_workers`."""
    started = time.monotonic()
    while True:
        try:
            return next(rows, None)
        except RuntimeError as error:
            if dead := [worker for worker in workers if not worker.is_alive()]:
                found = f"a loader worker has ended unexpectedly (exit code {dead[0].exitcode})"
                fix = f"If memory is full, lower data.workers. With {_NO_WORKERS} there are no workers"
                raise UnreachableError(where="data.workers", found=found, fix=fix) from error
            if "timed out" not in str(error):
                raise
        stop = stop_request()
        if min(stop.age_s, time.monotonic() - started) > _GRACE_S:
            found, fix = f"no batch after {stop.reason}", "The same command resumes from the newest checkpoint"
            raise UnreachableError(where="data", found=found, needed=f"one within {_GRACE_S:.0f} s", fix=fix)


def _end_workers(workers: Iterable[BaseProcess]) -> None:
    """Kill workers that did not end on request: blocked by a clip, and ignoring SIGTERM."""
    for worker in workers:
        if worker.is_alive():
            worker.kill()


def _start_servers() -> None:
    """Start the fork server with safe imports, and with a run's stop signals blocked, which its workers inherit.

    A signal to the whole process group, as from a terminal, `timeout` or Slurm, is for the run: it needs its workers to
    finish the step, and ends them.
    """
    stop = {signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP}
    for start in (resource_tracker.ensure_running, forkserver.ensure_running):  # the first one clears the mask
        before = signal.pthread_sigmask(signal.SIG_BLOCK, stop)
        try:
            with safe_imports():
                start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


# ---- in a worker ----


def in_worker() -> bool:
    """Return whether this process is a loader worker."""
    return get_worker_info() is not None


def _prepare_worker(_worker: int) -> None:
    """End this worker when its reading process has ended for any reason, or when a batch cannot be sent.

    PyTorch's own watchdog checks the fork server, which lives as long as its workers: both would stay for ever. The
    thread that sends batches only prints its errors: the run would wait for the batch for ever.
    """
    queues.Queue._on_queue_feeder_error = staticmethod(_end_without_sending)  # type: ignore[attr-defined]  # untyped
    run = multiprocessing.parent_process()
    if run is None:
        raise ValueError("not in a worker")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run, which ends its workers

    def watch() -> None:
        run.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _end_without_sending(error: BaseException, _batch: object) -> None:
    sys.stderr.write(f"A loader worker cannot send a batch: {type(error).__name__}: {error}\n")
    os._exit(1)


# ---- shared memory ----


def require_shared_memory(data: DataConfig, batch_bytes: float, processes: int = 1) -> None:
    """Check that shared memory has room for the batches that workers prefetch; a container has 64 MB by default.

    Args:
        data: The config.
        batch_bytes: Size of a batch.
        processes: Number of processes of the run on this machine.

    Raises:
        UnreachableError: There is less room.
    """
    needed = processes * data.workers * PREFETCH * batch_bytes
    free = shutil.disk_usage(SHARED_MEMORY).free if SHARED_MEMORY.is_dir() else math.inf
    if needed > free:
        text = f"{counted(processes * data.workers, 'worker')} x {PREFETCH} batches of {_megabytes(batch_bytes)}"
        text = f"{_megabytes(needed)}, for {text} in advance"
        raise UnreachableError(where=str(SHARED_MEMORY), found=f"{_megabytes(free)} free", needed=text, fix=_ROOM)


def in_shared_memory(batch: Batch) -> Batch:
    """Return a batch in shared memory. PyTorch would move it in the thread that sends it, whose errors get lost.

    Raises:
        UnreachableError: There is no room.
    """
    try:
        return batch.mapped(Tensor.share_memory_)
    except RuntimeError as error:
        found = f"no room for a batch of {_megabytes(batch.nbytes)} from a loader worker ({error})"
        raise UnreachableError(where=str(SHARED_MEMORY), found=found, fix=_ROOM) from None


def _megabytes(size: float) -> str:
    return f"{size / 1e6:.3g} MB"
