"""Worker processes of the loader: they ignore the run's signals and end with the run."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable
from multiprocessing import forkserver, resource_tracker


def end_workers(workers: Iterable[multiprocessing.process.BaseProcess]) -> None:
    """Kill workers that did not end on request: blocked by a clip, and ignoring SIGTERM."""
    for worker in workers:
        if worker.is_alive():
            worker.kill()


def start_servers_deaf() -> None:
    """Start the fork server with a run's stop signals blocked, which its workers inherit.

    A signal to the whole process group, as from a terminal, `timeout` or Slurm, is for the run: it needs its workers to
    finish the step, and ends them.
    """
    for start in (resource_tracker.ensure_running, forkserver.ensure_running):  # the first one clears the mask
        before = signal.pthread_sigmask(
            signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP}
        )
        try:
            start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_the_run(_worker: int) -> None:
    """End this worker when its reading process has ended for any reason.

    PyTorch's own watchdog checks the fork server, which lives as long as its workers: both would stay for ever.
    """
    run = multiprocessing.parent_process()
    if run is None:
        raise ValueError("not in a worker")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run, which ends its workers

    def watch() -> None:
        run.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
