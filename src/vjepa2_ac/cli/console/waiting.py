"""A line on stderr about the current work of a command that has printed nothing for some seconds.

A progress bar writes all the time, so the line never appears beside a running one. Nothing heavy is imported.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator

from vjepa2_ac.errors import printable
from vjepa2_ac.process import is_first, silent_s

_SILENT_S = (5.0, 15.0, 60.0)  # seconds without output before the first, the second and each further line about a work
_CHECK_S = 0.25


_work = ("", 0.0)  # what the command does, and since when


def begin_work(title: str) -> None:
    """Set what the command does from now on; empty: nothing to report, as in a server that waits for requests."""
    global _work
    _work = (title, time.monotonic())


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
    work, lines = _work, 0
    while not ended.wait(_CHECK_S):
        if work is not _work:
            work, lines = _work, 0
        (title, began), least_s = work, _SILENT_S[min(lines, len(_SILENT_S) - 1)]
        if title and min(silent_s(), time.monotonic() - began) >= least_s:
            lines += 1
            print(printable(f"{title}: {time.monotonic() - began:.0f} s so far"), file=sys.stderr)
