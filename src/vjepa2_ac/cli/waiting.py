"""Status lines on stderr while a command prints nothing for some seconds.

A running progress bar prints continuously, so the lines never interrupt it. The module imports no large library,
because it runs while large libraries are imported.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator

from vjepa2_ac.errors import printable
from vjepa2_ac.process import is_first_process, seconds_since_output

_SILENT_S = (5.0, 15.0, 60.0)  # seconds without output before the first, second and each further line of a task
_CHECK_S = 0.25


class Work:
    """The current task of the command. Its state is global, because a process has one console."""

    title = ""  # empty: print nothing, for example while a server waits for requests
    began = 0.0
    lines = 0  # number of status lines printed for this task

    @classmethod
    def begin(cls, title: str) -> None:
        """Set the current task; with an empty title no status lines are printed."""
        cls.title, cls.began, cls.lines = title, time.monotonic(), 0


@contextlib.contextmanager
def watch_silence() -> Iterator[None]:
    """Print the current task whenever the command printed nothing for some seconds, within the context."""
    Work.begin("loading libraries and model")
    ended = threading.Event()
    if is_first_process():
        threading.Thread(target=_watch, args=(ended,), daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def _watch(ended: threading.Event) -> None:
    while not ended.wait(_CHECK_S):
        elapsed_s = time.monotonic() - Work.began
        if Work.title and min(seconds_since_output(), elapsed_s) >= _SILENT_S[min(Work.lines, len(_SILENT_S) - 1)]:
            Work.lines += 1
            print(printable(f"{Work.title}: {elapsed_s:.0f} s so far"), file=sys.stderr)
