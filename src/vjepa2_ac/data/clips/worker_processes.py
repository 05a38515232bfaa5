"""Worker processes of the loader: they ignore the run's signals and end with the run."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable
from multiprocessing import forkserver, resource_tracker

from vjepa2_ac import output


def end_workers(workers: Iterable[multiprocessing.process.BaseProcess]) -> None:
    """End workers that did not when they were asked: busy with a clip that does not come, and deaf to SIGTERM."""
    for worker in workers:
        if worker.is_alive():
            worker.kill()


def start_servers_deaf() -> None:
    """Start the processes that workers come from with the signals blocked that ask a run to stop, also in workers.

    Who signals the whole process group, as a terminal, `timeout` and Slurm do, means the run: it needs its workers to
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
    """End this worker when the process that reads from it is gone, however it went.

    PyTorch's own watch looks at the fork server, which lives as long as its workers: both would stay for ever.
    """
    run = multiprocessing.parent_process()
    if run is None:
        raise ValueError("not in a worker")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run, which ends its workers
    output.never_wait()  # a warning that nobody reads must not hold up the batch

    def watch() -> None:
        run.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
