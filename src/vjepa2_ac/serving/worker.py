"""The planning thread: planning never runs where sockets are served, so that pings are answered during a decision."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

_Found = TypeVar("_Found")


class GoneError(Exception):
    """Nobody waits for the answer any more."""


class Worker:
    """One thread that does one thing after another. It does not keep the process alive."""

    def __init__(self) -> None:
        self._work: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="planning", daemon=True)
        self._thread.start()

    def submit(self, work: Callable[[], _Found]) -> Future[_Found]:
        """Do something after all that was submitted before."""
        future: Future[_Found] = Future()
        self._work.put((future, work))
        return future

    def end(self, within_s: float) -> bool:
        """End after what was submitted; return whether that took no longer than this."""
        self._work.put(None)
        self._thread.join(within_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (item := self._work.get()) is not None:
            future, work = item
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(work())
                except BaseException as error:
                    future.set_exception(error)
