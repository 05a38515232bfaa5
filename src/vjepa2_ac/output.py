"""Terminal output of a command: it never raises, and during a run it never blocks.

`own_streams` replaces standard output and standard error with streams of ours, for everything that writes there: the
console, warnings, libraries. Text that they cannot write is dropped: the reader has closed the pipe (`| head`), the
terminal is gone, the disk of a log is full. They never raise, so that output cannot end the work that it reports.

After `never_wait` text is written by a thread instead. A pipe that nobody reads, a terminal stopped with Ctrl-S or a
stalled disk then blocks that thread only; text that does not fit into its queue is dropped and counted.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import select
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

MOST_BYTES = 1 << 20  # that may wait for a reader
LAST_S = 5.0  # that the end of a run waits for a reader
_LAST_WARNING_S = 1.0

_LEFT = frozenset({errno.EPIPE, errno.ECONNRESET})  # the reader has closed the stream
_NAMES = {"stdout": "standard output", "stderr": "standard error"}


class Writer:
    """Writes bytes to a file descriptor, and never raises.

    Args:
        handle: The descriptor; it stays open.
    """

    def __init__(self, handle: int) -> None:
        self.handle = handle
        self.problem: OSError | None = None  # nothing is written after it
        self.lines_dropped = 0  # because they were not read in time
        self._is_terminal = os.isatty(handle)
        self._process = os.getpid()
        self._thread: threading.Thread | None = None
        self._waiting: deque[bytes] = deque()
        self._bytes, self._lines = 0, 0  # waiting, or being written by the thread
        self._changed = threading.Condition()

    @property
    def has_lost(self) -> bool:
        """Whether output is missing that would have been read: the disk of a file is full."""
        return self.problem is not None and self.problem.errno not in _LEFT and not self._is_terminal

    def write(self, data: bytes) -> None:
        """Write, or queue for the thread if there is one; drop what does not fit."""
        if self._thread is None or os.getpid() != self._process:  # a forked process has no thread
            self._write(data)
            return
        with self._changed:
            if self._bytes and self._bytes + len(data) > MOST_BYTES:
                self.lines_dropped += data.count(b"\n")
                return
            self._waiting.append(data)
            self._count(data, 1)
            self._changed.notify_all()

    def never_wait(self) -> None:
        """Write in a thread from now on."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, name="console", daemon=True)
            self._thread.start()

    def finish(self, within_s: float) -> None:
        """Wait until queued data is written, at most `within_s`: the rest is dropped."""
        with self._changed:
            if not self._changed.wait_for(lambda: not self._bytes, within_s):
                self.lines_dropped += self._lines

    def _serve(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting)
                data = b"".join(self._waiting)
                self._waiting.clear()
            self._write(data)
            with self._changed:
                self._count(data, -1)
                self._changed.notify_all()

    def _count(self, data: bytes, sign: int) -> None:
        self._bytes += sign * len(data)
        self._lines += sign * data.count(b"\n")

    def _write(self, data: bytes) -> None:
        left = memoryview(data)
        while left and self.problem is None:
            try:
                left = left[os.write(self.handle, left) :]
            except BlockingIOError:  # another process that shares this file has made it non-blocking
                ready = select.poll()
                ready.register(self.handle, select.POLLOUT)
                ready.poll()
            except OSError as error:
                self.problem = error


class _Raw(io.RawIOBase):
    """The raw stream below a text stream."""

    def __init__(self, writer: Writer, handle: int) -> None:
        self._writer, self._handle = writer, handle

    def writable(self) -> bool:
        return True

    def write(self, data: Any, /) -> int:
        self._writer.write(bytes(data))
        return len(data)

    def fileno(self) -> int:
        return self._handle

    def isatty(self) -> bool:
        return os.isatty(self._handle)


class Streams:
    """Standard output and standard error of this process, by their names in `sys`."""

    def __init__(self) -> None:
        self.writers: dict[str, Writer] = {}
        self._waits = True  # whether writes wait for readers
        self._before: dict[str, Any] = {}
        self._by_file: dict[tuple[int, int, int], Writer] = {}

    def put_in_place(self) -> None:
        """Send all output of this process through these streams; streams that others have replaced stay."""
        for number, name in enumerate(_NAMES, start=1):
            stream = getattr(sys, name)
            if stream is None:  # it was closed when the process started
                _occupy_closed_numbers()
                self._replace(name, number, "utf-8")
            elif stream is getattr(sys, f"__{name}__"):
                with contextlib.suppress(OSError, ValueError):  # it has no file, or a closed one
                    stream.flush()
                    self._replace(name, stream.fileno(), stream.encoding)

    def put_back(self) -> None:
        """Restore the streams of `sys`, which hold no buffered text."""
        for name, stream in self._before.items():
            setattr(sys, name, stream)

    def never_wait(self) -> None:
        """Never block from now on."""
        self._waits = False
        for writer in self.writers.values():
            writer.never_wait()

    def finish(self) -> None:
        """Give readers some time to finish; in a run, report in one stream what is missing in the other."""
        until = time.monotonic() + LAST_S
        for writer in self.writers.values():
            writer.finish(max(0.0, until - time.monotonic()))
        for name, writer in self.writers.items() if not self._waits else ():
            for other in self.writers.values():
                if other is not writer and (missing := _what_is_missing(writer)):
                    other.write(f"warning: {_NAMES[name]}: {missing}\n".encode())
                    other.finish(_LAST_WARNING_S)

    def what_was_lost(self) -> str:
        """Return the error of a command whose output could not be written; empty: there is none."""
        writer = self.writers.get("stdout")
        return f"{_NAMES['stdout']}: {_what_is_missing(writer)}" if self._waits and writer and writer.has_lost else ""

    def _replace(self, name: str, handle: int, encoding: str) -> None:
        about = os.fstat(handle)
        writer = self._by_file.setdefault((about.st_dev, about.st_ino, about.st_rdev), Writer(handle))
        self.writers[name], self._before[name] = writer, getattr(sys, name)
        raw: Any = _Raw(writer, handle)
        setattr(sys, name, io.TextIOWrapper(raw, encoding=encoding, errors="backslashreplace", write_through=True))


_streams: Streams | None = None


@contextlib.contextmanager
def own_streams() -> Iterator[Streams]:
    """Send all output of this process through streams that never raise, within the context.

    Streams that are not the process's own, such as those of a test or a notebook, are not changed.
    """
    global _streams
    before, _streams = _streams, Streams()
    _streams.put_in_place()
    try:
        yield _streams
    finally:
        _streams.finish()
        _streams.put_back()
        _streams = before


def never_wait() -> None:
    """Never let a reader block this process from now on: its work matters more than its output."""
    global _streams
    if _streams is None:  # a worker process of another one
        _streams = Streams()
        _streams.put_in_place()
    _streams.never_wait()


def _occupy_closed_numbers() -> None:
    """Open /dev/null as 0, 1 and 2 where free: else the next file gets that number, and libraries write into it."""
    while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(handle)


def _what_is_missing(writer: Writer) -> str:
    if writer.has_lost and writer.problem:
        return f"cannot be written ({writer.problem.strerror}): some output is missing"
    if writer.lines_dropped:
        return f"{writer.lines_dropped} lines were dropped, because they were not read in time"
    return ""
