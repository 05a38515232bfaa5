"""A line on stderr about the current work of a command that has printed nothing for some seconds.

A running progress bar writes all the time, so the line never appears next to it. Nothing heavy is imported.
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


class Work:
    """What the command does now; there is one, as there is one console."""

    title = ""  # empty: nothing to report, as in a server that waits for requests
    began = 0.0
    lines = 0  # about this work, which were printed

    @classmethod
    def begin(cls, title: str) -> None:
        """Set what the command does from now on; empty: nothing to report."""
        cls.title, cls.began, cls.lines = title, time.monotonic(), 0


@contextlib.contextmanager
def watch_silence() -> Iterator[None]:
    """Print what the command does if it is silent for some seconds, within the context."""
    Work.begin("loading libraries and model")
    ended = threading.Event()
    if is_first():
        threading.Thread(target=_watch, args=(ended,), daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def _watch(ended: threading.Event) -> None:
    while not ended.wait(_CHECK_S):
        elapsed_s = time.monotonic() - Work.began
        if Work.title and min(silent_s(), elapsed_s) >= _SILENT_S[min(Work.lines, len(_SILENT_S) - 1)]:
            Work.lines += 1
            print(printable(f"{Work.title}: {elapsed_s:.0f} s so far"), file=sys.stderr)
