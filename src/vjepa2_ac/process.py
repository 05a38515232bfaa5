"""A process and who started it: its terminal never ends the work that it reports, and signals end it tidily.

Output that cannot be written is dropped: the reader has closed the pipe (`| head`), the terminal is gone, the disk of a
log is full, and a training goes on.

`stop_on_signals`: the first SIGTERM, SIGINT (Ctrl-C), SIGUSR1 or SIGHUP is recorded: the loop finishes its optimizer
step, and the validation that is due after it, writes a checkpoint and raises `StoppedError`. The command line then
exits with `EXIT_STATUS`. A second signal has its default effect, which ends the process; checkpoints are complete or
absent, whenever that happens.

SIGHUP means that the terminal is gone: shell and kernel send one each, so only the first counts. To let a run outlive
its terminal, start it with `nohup` or in tmux.
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
SAME_WITHIN_S = 0.5  # another signal is the same request: `timeout` and launchers signal a process and its group
EXIT_STATUS = 75  # sysexits.h, EX_TEMPFAIL: the same command resumes
_LEFT = frozenset({errno.EPIPE, errno.ECONNRESET})  # the reader has closed the stream
_NAMES = ("stdout", "stderr")
_SAFE_PATH = "PYTHONSAFEPATH"


def is_first_process() -> bool:
    """Return whether this is the only process, or the first of several: the one that speaks and writes."""
    return os.environ.get("RANK", "0") == "0"


# ---- output ----


class _Stream(io.FileIO):
    """A file descriptor, which stays open; writing never raises."""

    problem: OSError | None = None  # the first one
    last_write = time.monotonic()  # of all of them

    def write(self, data: Any, /) -> int:
        """Write all bytes, or drop what cannot be written; return their number."""
        left, _Stream.last_write = memoryview(data), time.monotonic()
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
def guard_output() -> Iterator[Callable[[], str]]:
    """Send all output of this process through streams that never raise, within the context.

    Streams that are not the process's own, such as those of a test or a notebook, are not changed. Yields a function
    that returns why some of the standard output was lost; empty where none was, or its reader has left.
    """
    if None in (sys.stdout, sys.stderr):  # or the next file gets the number of one, and libraries write into it
        while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
            pass
        os.close(handle)
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


def seconds_since_output() -> float:
    """Return the seconds since this process printed something; 0 outside of `guard_output`."""
    raw = getattr(sys.stderr, "buffer", None)
    return time.monotonic() - _Stream.last_write if isinstance(raw, _Stream) else 0.0


# ---- processes that this one starts ----


@contextlib.contextmanager
def safe_imports() -> Iterator[None]:
    """Let Python processes that are started within the context import nothing from the working directory.

    Python puts the directory first for `-c` and `-m`, which multiprocessing uses: a user's `random.py` would be run.
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
    """A run stopped on request; its checkpoint is written, and the same command resumes from it.

    Args:
        folder: The run's folder.
        step: Optimizer steps done.
        reason: The name of the signal.
    """

    def __init__(self, folder: Path, step: int, reason: str) -> None:
        self.folder, self.step, self.reason = folder, step, reason
        super().__init__(f"{reason}: stopped after step {step:,}; the same command goes on from there")


class SignalExit(BaseException):
    """Ends the current work, as KeyboardInterrupt does, so that temporary files are removed.

    Args:
        number: The signal.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(signal.Signals(number).name)


class StopRequest:
    """Records whether a signal has requested a stop, and which."""

    def __init__(self) -> None:
        self.number = 0  # of the signal; 0: none
        self._came_at = 0.0

    @property
    def age_s(self) -> float:
        """Seconds since the signal; 0: none."""
        return time.monotonic() - self._came_at if self.number else 0.0

    @property
    def reason(self) -> str | None:
        """The signal's name; None: none."""
        return signal.Signals(self.number).name if self.number else None

    def take(self, number: int, _frame: FrameType | None) -> None:
        """Record a first signal; give a second one its default effect."""
        if not self.number:
            self.number, self._came_at = number, time.monotonic()
        elif number != HANG_UP and time.monotonic() - self._came_at >= SAME_WITHIN_S:
            exit_by_signal(number)


@contextlib.contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Record signals instead of being killed by them, within the context; afterwards the old handlers are restored.

    Nothing changes outside the main thread, where Python handles no signals, and for signals that the process was
    started to ignore (`nohup`, a shell's `&`).
    """
    request = StopRequest()
    taken = [number for number in (*SIGNALS, HANG_UP) if signal.getsignal(number) is not signal.SIG_IGN]
    _requests.append(request)
    try:
        with _handled(taken, request.take):
            yield request
    finally:
        _requests.remove(request)


_requests: list[StopRequest] = []


def stop_request() -> StopRequest:
    """Return the record of `stop_on_signals`; outside of it an empty one."""
    return _requests[-1] if _requests else StopRequest()


@contextlib.contextmanager
def exit_on_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block cleanly, and then the process; a second one ends it at once.

    Outside the main thread, and for signals that already have a handler, nothing is changed.
    """
    first = StopRequest()

    def end(number: int, frame: FrameType | None) -> None:
        is_first_process = not first.number
        first.take(number, frame)
        if is_first_process:
            raise SignalExit(number)

    try:
        with _handled([one for one in (signal.SIGTERM, HANG_UP) if signal.getsignal(one) is signal.SIG_DFL], end):
            yield
    except SignalExit as ended:
        exit_by_signal(ended.number)


def exit_by_signal(number: int) -> None:
    """Give a signal its default effect, and this process the signal."""
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
