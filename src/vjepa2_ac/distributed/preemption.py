"""Stop requests by SIGTERM, SIGINT (Ctrl-C), SIGUSR1 and SIGHUP: the loop stops where it can be resumed.

The first signal is recorded: the loop finishes its optimizer step, and the validation that is due after it, writes a
checkpoint and raises `StoppedError`. The command line then exits with `EXIT_STATUS`. A second signal stops at once: it
has its default effect, which ends the process; checkpoints are complete or absent, whenever that happens.

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

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)
HANG_UP = signal.SIGHUP
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


class StopRequest:
    """Records whether a signal has requested a stop, and which."""

    def __init__(self) -> None:
        self.reason: str | None = None
        self._came_at = 0.0

    @property
    def number(self) -> int:
        """The signal's number; 0: none."""
        return 0 if self.reason is None else signal.Signals[self.reason].value

    def take(self, number: int, _frame: FrameType | None) -> None:
        """Record a first signal; give a second one its default effect."""
        if self.reason is None:
            self.reason, self._came_at = signal.Signals(number).name, time.monotonic()
        elif number != HANG_UP and time.monotonic() - self._came_at >= SAME_WITHIN_S:
            end_by(number)


def end_by(number: int) -> None:
    """Give a signal its default effect, and this process the signal."""
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


@contextlib.contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Record signals instead of being killed by them, within the context; afterwards the old handlers are restored.

    Nothing changes outside the main thread, where Python handles no signals, and for signals that the process was
    started to ignore (`nohup`, a shell's `&`).
    """
    request = StopRequest()
    taken = [number for number in (*SIGNALS, HANG_UP) if signal.getsignal(number) is not signal.SIG_IGN]
    with handle_signals(taken, request.take):
        yield request


@contextlib.contextmanager
def handle_signals(numbers: Iterable[int], handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle signals within the context, in the main thread; afterwards the old handlers are restored."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, signal.SIG_DFL if old is None else old)
