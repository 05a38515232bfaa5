"""Cells of a benchmark that trains models: each is computed in a process of its own, on one thread."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any


def in_processes(
    do: Callable[..., Any], work: Sequence[tuple[Any, ...]], workers: int, keep: Callable[[Any, Any], None]
) -> int:
    """Do work in processes of their own; return how much of it failed, which is printed.

    Args:
        do: A function of a module, which a process of its own can import.
        work: Its arguments; the first one has a name.
        workers: Processes at once.
        keep: Called here with the first argument and the result, in the order in which they are done.

    Raises:
        BrokenProcessPool: A process was killed, most likely for its memory.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    context, failed = multiprocessing.get_context("spawn"), 0
    with ProcessPoolExecutor(workers, mp_context=context, max_tasks_per_child=1) as pool:
        waiting: dict[Future[Any], Any] = {pool.submit(do, *one): one[0] for one in work}
        for done in as_completed(waiting):
            try:
                found = done.result()
            except BrokenProcessPool:
                raise
            except Exception as error:  # one must not cost the others
                print(f"{waiting[done].name} failed: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
                failed += 1
                continue
            keep(waiting[done], found)
    return failed
