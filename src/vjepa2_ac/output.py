"""Terminal output of a command never ends the work that it reports: what cannot be written is dropped.

The reader has closed the pipe (`| head`), the terminal is gone, the disk of a log is full: a training goes on.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import select
import sys
from collections.abc import Callable, Iterator
from typing import Any

_LEFT = frozenset({errno.EPIPE, errno.ECONNRESET})  # the reader has closed the stream
_NAMES = ("stdout", "stderr")


class _Stream(io.FileIO):
    """A file descriptor, which stays open; writing never raises."""

    problem: OSError | None = None  # the first one

    def write(self, data: Any, /) -> int:
        """Write all bytes, or drop what cannot be written; return their number."""
        left = memoryview(data)
        try:
            while left:
                try:
                    left = left[os.write(self.fileno(), left) :]
                except BlockingIOError:  # another process that shares this file has made it non-blocking
                    select.select((), (self,), ())
        except OSError as error:
            self.problem = self.problem or error
        return len(data)


@contextlib.contextmanager
def own_streams() -> Iterator[Callable[[], str]]:
    """Send all output of this process through streams that never raise, within the context.

    Streams that are not the process's own, such as those of a test or a notebook, are not changed. Yields a function
    that returns why some of the standard output was lost; empty where none was, or its reader has left.
    """
    if None in (sys.stdout, sys.stderr):
        _occupy_closed_numbers()
    before, ours = {name: getattr(sys, name) for name in _NAMES}, dict[str, _Stream]()
    for number, (name, stream) in enumerate(before.items(), start=1):
        if stream is getattr(sys, f"__{name}__"):  # None: it was closed when the process started
            if stream is not None:
                stream.flush()
            ours[name] = _Stream(number if stream is None else stream.fileno(), "w", closefd=False)
            encoding = "utf-8" if stream is None else stream.encoding
            raw: Any = ours[name]  # without a buffer: nothing is left to be written when the process ends
            setattr(sys, name, io.TextIOWrapper(raw, encoding, "backslashreplace", write_through=True))

    on_terminal = "stdout" in ours and ours["stdout"].isatty()  # which may be gone in the end

    def lost() -> str:
        problem = ours["stdout"].problem if "stdout" in ours and not on_terminal else None
        return "" if problem is None or problem.errno in _LEFT else str(problem.strerror)

    try:
        yield lost
    finally:
        for name in ours:
            setattr(sys, name, before[name])


def _occupy_closed_numbers() -> None:
    """Open /dev/null as 0, 1 and 2 where free: else the next file gets that number, and libraries write into it."""
    while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(handle)
