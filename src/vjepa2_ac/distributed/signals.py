"""Signals: training stops where it can be resumed; other commands remove partial files and end with the signal.

`stop_on_signals`: the first SIGTERM, SIGINT (Ctrl-C), SIGUSR1 or SIGHUP is recorded: the loop finishes its optimizer
step, and the validation that is due after it, writes a checkpoint and raises `StoppedError`. The command line then
exits with `EXIT_STATUS`. A second signal has its default effect, which ends the process; checkpoints are complete or
absent, whenever that happens.

SIGHUP means that the terminal is gone: shell and kernel send one each, so only the first counts. To let a run outlive
its terminal, start it with `nohup` or in tmux.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType

HANG_UP = signal.SIGHUP
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)
SAME_WITHIN_S = 0.5  # another signal is the same request: `timeout` and launchers signal a process and its group
EXIT_STATUS = 75  # sysexits.h, EX_TEMPFAIL: the same command resumes


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


class EndedError(BaseException):
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
    def reason(self) -> str | None:
        """The signal's name; None: none."""
        return signal.Signals(self.number).name if self.number else None

    def take(self, number: int, _frame: FrameType | None) -> None:
        """Record a first signal; give a second one its default effect."""
        if not self.number:
            self.number, self._came_at = number, time.monotonic()
        elif number != HANG_UP and time.monotonic() - self._came_at >= SAME_WITHIN_S:
            end_by(number)


@contextlib.contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Record signals instead of being killed by them, within the context; afterwards the old handlers are restored.

    Nothing changes outside the main thread, where Python handles no signals, and for signals that the process was
    started to ignore (`nohup`, a shell's `&`).
    """
    request = StopRequest()
    taken = [number for number in (*SIGNALS, HANG_UP) if signal.getsignal(number) is not signal.SIG_IGN]
    with _handled(taken, request.take):
        yield request


@contextlib.contextmanager
def tidy_end() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block cleanly, and then the process; a second one ends it at once.

    Outside the main thread, and for signals that already have a handler, nothing is changed.
    """
    first = StopRequest()

    def end(number: int, frame: FrameType | None) -> None:
        is_first = not first.number
        first.take(number, frame)
        if is_first:
            raise EndedError(number)

    try:
        with _handled([one for one in (signal.SIGTERM, HANG_UP) if signal.getsignal(one) is signal.SIG_DFL], end):
            yield
    except EndedError as ended:
        end_by(ended.number)


def end_by(number: int) -> None:
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
