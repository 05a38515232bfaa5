"""A line on stderr about the current work of a command that has printed nothing for some seconds.

A progress bar writes all the time, so the line never appears beside a running one. Nothing heavy is imported.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

from vjepa2_ac.errors import printable
from vjepa2_ac.process import is_first, silent_s

_SILENT_S = (5.0, 15.0, 60.0)  # seconds without output before the first, the second and each further line about a work
_CHECK_S = 0.25


@dataclass
class _Work:
    title: str  # what the command does; empty: nothing to report, as in a server that waits for requests
    began: float
    lines: int = 0  # about this work, which were printed


_work = _Work("", 0.0)


def begin_work(title: str) -> None:
    """Set what the command does from now on; empty: nothing to report."""
    global _work
    _work = _Work(title, time.monotonic())


def count_line() -> None:
    """Note that a line about the current work was printed."""
    _work.lines += 1


@contextlib.contextmanager
def watch_silence() -> Iterator[None]:
    """Print what the command does if it is silent for some seconds, within the context."""
    begin_work("loading libraries and model")
    ended = threading.Event()
    if is_first():
        threading.Thread(target=_watch, args=(ended,), daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def _watch(ended: threading.Event) -> None:
    while not ended.wait(_CHECK_S):
        work, now = _work, time.monotonic()
        if work.title and min(silent_s(), now - work.began) >= _SILENT_S[min(work.lines, len(_SILENT_S) - 1)]:
            count_line()
            print(printable(f"{work.title}: {now - work.began:.0f} s so far"), file=sys.stderr)
