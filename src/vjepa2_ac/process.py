"""Output and signals of this process: output errors do not stop a training run, and signals end it cleanly.

Output that cannot be written is dropped: if the reader has closed the pipe (`| head`), the terminal is gone, or the
disk of a log is full, a training run continues.

`stop_on_signals` records the first SIGTERM, SIGINT (Ctrl-C), SIGUSR1 or SIGHUP. The training loop then finishes its
optimizer step and the validation that is due after it, writes a checkpoint and raises `StoppedError`. The command line
exits with `EXIT_STATUS`. A second signal has its default effect, which ends the process; checkpoints are complete or
absent, whenever that happens.

SIGHUP means that the terminal is gone. Shell and kernel send one each, so only the first has an effect. To let a run
outlive its terminal, start it with `nohup` or in tmux.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

HANG_UP = signal.SIGHUP
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)
SAME_WITHIN_S = 0.5  # signals within this time are one request: `timeout` and launchers signal process and group
EXIT_STATUS = 75  # sysexits.h, EX_TEMPFAIL: the same command resumes
_READER_CLOSED = frozenset({errno.EPIPE, errno.ECONNRESET})  # the reader has closed the stream
_NAMES = ("stdout", "stderr")
_SAFE_PATH = "PYTHONSAFEPATH"


def is_first_process() -> bool:
    """Return whether this is the only process, or the first of several, which prints and writes."""
    return os.environ.get("RANK", "0") == "0"


# ---- output ----


class _Stream(io.FileIO):
    """A file descriptor whose writes never raise. It is not closed with the stream."""

    problem: OSError | None = None  # first error of a write
    last_write = time.monotonic()  # time of the last write to any stream

    def write(self, data: Any, /) -> int:
        """Write the bytes and return their number; bytes that cannot be written are dropped."""
        rest, _Stream.last_write = memoryview(data), time.monotonic()
        try:
            while rest:
                try:
                    rest = rest[os.write(self.fileno(), rest) :]
                except BlockingIOError:  # another process that shares this file has made it non-blocking
                    select.select((), (self,), ())
        except OSError as error:
            self.problem = self.problem or error
        return len(data)


@contextlib.contextmanager
def guard_output() -> Iterator[Callable[[], str]]:
    """Send all output of this process through streams that never raise, within the context.

    Replaced streams, such as those of a test or a notebook, are not changed. Yields a function that returns the reason
    why standard output was lost; empty if none was lost, or if the reader has closed it.
    """
    # Without open descriptors 1 and 2 the next opened file would get one of them, and libraries would write into it.
    if None in (sys.stdout, sys.stderr):
        while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
            pass
        os.close(handle)
    before, guarded = {name: getattr(sys, name) for name in _NAMES}, dict[str, _Stream]()
    for number, (name, stream) in enumerate(before.items(), start=1):
        if stream is getattr(sys, f"__{name}__"):  # None: it was closed when the process started
            if stream is not None:
                stream.flush()
            guarded[name] = _Stream(number if stream is None else stream.fileno(), "w", closefd=False)
            encoding = "utf-8" if stream is None else stream.encoding
            raw: Any = guarded[name]  # unbuffered, so that no output is pending when the process ends
            setattr(sys, name, io.TextIOWrapper(raw, encoding, "backslashreplace", write_through=True))

    on_terminal = "stdout" in guarded and guarded["stdout"].isatty()  # a closed terminal is no error

    def lost() -> str:
        problem = guarded["stdout"].problem if "stdout" in guarded and not on_terminal else None
        return "" if problem is None or problem.errno in _READER_CLOSED else str(problem.strerror)

    try:
        yield lost
    finally:
        for name in guarded:
            setattr(sys, name, before[name])


def seconds_since_output() -> float:
    """Return the seconds since the last output of this process; 0 outside of `guard_output`."""
    raw = getattr(sys.stderr, "buffer", None)
    return time.monotonic() - _Stream.last_write if isinstance(raw, _Stream) else 0.0


# ---- processes that this one starts ----


@contextlib.contextmanager
def safe_imports() -> Iterator[None]:
    """Keep the working directory off `sys.path` of Python processes started within the context.

    Python puts the directory first for `-c` and `-m`, as multiprocessing does, and would import a user's `random.py`.
    """
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        os.environ.pop(_SAFE_PATH)
        os.environ.update({} if before is None else {_SAFE_PATH: before})


# ---- signals ----


class StoppedError(Exception):
    """A run was stopped on request, after writing a checkpoint. The same command resumes from it.

    Args:
        folder: The run's folder.
        step: Number of optimizer steps done.
        reason: The name of the signal.
    """

    def __init__(self, folder: Path, step: int, reason: str) -> None:
        self.folder, self.step, self.reason = folder, step, reason
        super().__init__(f"{reason}: stopped after step {step:,}. Run the same command again to resume")


class SignalExit(BaseException):
    """Raised by a signal to unwind the stack, as KeyboardInterrupt, so that temporary files are removed.

    Args:
        number: The signal.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(signal.Signals(number).name)


class StopRequest:
    """The first signal that requested a stop, if any."""

    def __init__(self) -> None:
        self.number = 0  # number of the signal; 0: none
        self._received_at = 0.0

    @property
    def age_s(self) -> float:
        """Seconds since the signal; 0 without a signal."""
        return time.monotonic() - self._received_at if self.number else 0.0

    @property
    def reason(self) -> str | None:
        """Name of the signal; None without a signal."""
        return signal.Signals(self.number).name if self.number else None

    def record(self, number: int, _frame: FrameType | None) -> None:
        """Record a first signal; give a second one its default effect."""
        if not self.number:
            self.number, self._received_at = number, time.monotonic()
        elif number != HANG_UP and time.monotonic() - self._received_at >= SAME_WITHIN_S:
            exit_by_signal(number)


@contextlib.contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Record signals within the context instead of exiting; restore the old handlers afterwards.

    This has no effect outside the main thread, where Python handles no signals, and for signals that the process
    ignores since its start (`nohup`, a shell's `&`).
    """
    request = StopRequest()
    numbers = [number for number in (*SIGNALS, HANG_UP) if signal.getsignal(number) is not signal.SIG_IGN]
    _requests.append(request)
    try:
        with _handled(numbers, request.record):
            yield request
    finally:
        _requests.remove(request)


_requests: list[StopRequest] = []


def stop_request() -> StopRequest:
    """Return the stop request of the innermost `stop_on_signals`; outside of it an empty one."""
    return _requests[-1] if _requests else StopRequest()


@contextlib.contextmanager
def exit_on_signals() -> Iterator[None]:
    """On SIGTERM or SIGHUP, unwind the block and then exit by the signal; a second signal exits at once.

    This has no effect outside the main thread, and for signals that already have a handler.
    """
    first = StopRequest()

    def end(number: int, frame: FrameType | None) -> None:
        is_first_signal = not first.number
        first.record(number, frame)
        if is_first_signal:
            raise SignalExit(number)

    numbers = [number for number in (signal.SIGTERM, HANG_UP) if signal.getsignal(number) is signal.SIG_DFL]
    try:
        with _handled(numbers, end):
            yield
    except SignalExit as received:
        exit_by_signal(received.number)


def exit_by_signal(number: int) -> None:
    """Exit by a signal: restore its default handler and send it to this process."""
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


@contextlib.contextmanager
def _handled(numbers: Iterable[int], handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, signal.SIG_DFL if old is None else old)
