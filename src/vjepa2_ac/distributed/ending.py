"""Signal handling of commands: on SIGTERM or SIGHUP, remove partial files, then exit with that signal.

For commands without handling of their own: a training run finishes its step first (`distributed.preemption`).
"""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Iterator
from types import FrameType

from vjepa2_ac.distributed import preemption

SIGNALS = (signal.SIGTERM, signal.SIGHUP)


class EndedError(BaseException):
    """Ends the current work, as KeyboardInterrupt does, so that temporary files are removed.

    Args:
        number: The signal.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(signal.Signals(number).name)


@contextlib.contextmanager
def tidy_end() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block cleanly, and then the process; a second one ends it at once.

    Outside the main thread, and for signals that already have a handler, nothing is changed.
    """
    came_at: list[float] = []

    def end(number: int, _frame: FrameType | None) -> None:
        if not came_at:
            came_at.append(time.monotonic())
            raise EndedError(number)
        if time.monotonic() - came_at[0] >= preemption.SAME_WITHIN_S:
            preemption.end_by(number)

    taken = [number for number in SIGNALS if signal.getsignal(number) is signal.SIG_DFL]
    try:
        with preemption.handle_signals(taken, end):
            yield
    except EndedError as ended:
        preemption.end_by(ended.number)
