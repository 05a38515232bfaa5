"""A tracker's thread: it takes the run's metrics from a queue, so that the tracker never blocks the run."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

logger = logging.getLogger(__name__)

MOST_ROWS = 10_000  # in the queue: some 15 MB
MOST_IMAGES = 8  # likewise

Image = UInt8[np.ndarray, "height width 3"]


@runtime_checkable
class Tracker(Protocol):
    """A tracker; its methods may raise anything, and take any time."""

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        """Log the metrics of a row, named kind/metric, and its optimizer step."""
        ...

    def log_image(self, name: str, image: Image, step: int) -> None:
        """Log an image, named kind/image, and its optimizer step."""
        ...

    def close(self) -> None:
        """Write pending rows."""
        ...


Opening = Callable[[], Tracker]
_Send = Callable[[Tracker], None]


class TrackerThread:
    """A tracker in its own thread, which opens it, sends it rows and closes it; problems are warned of once.

    Args:
        name: Its display name.
        opening: Opens it.
        patience_s: After which a warning says that it does not answer.
    """

    def __init__(self, name: str, opening: Opening, *, patience_s: float) -> None:
        self._name, self._opening, self._patience_s = name, opening, patience_s
        self._rows: queue.SimpleQueue[_Send | None] = queue.SimpleQueue()
        self._images = threading.BoundedSemaphore(MOST_IMAGES)  # free places in the queue
        self._problem, self._since_s = "cannot be opened", time.monotonic()  # of the current call
        self._warned, self._dropped = False, 0
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        """Queue a row."""
        self._put(lambda tracker: tracker.log(metrics, step))

    def log_image(self, name: str, image: Image, step: int) -> None:
        """Queue an image."""

        def send(tracker: Tracker) -> None:
            self._images.release()
            tracker.log_image(name, image, step)

        if self._images.acquire(blocking=False):
            self._put(send)
        else:
            self._dropped += 1

    def _put(self, send: _Send) -> None:
        if not self._thread.is_alive():
            return
        if self._rows.qsize() < MOST_ROWS:
            self._rows.put(send)
        else:
            self._dropped += 1
        if time.monotonic() - self._since_s > self._patience_s:
            self._warn(f"no answer within {self._patience_s:g} s", "its metrics wait")

    def end(self) -> None:
        """Close it after the last row; does not wait."""
        self._rows.put(None)

    def wait(self, within_s: float, limit_s: float) -> None:
        """Wait until it is closed, at most `within_s`.

        Args:
            within_s: The rest of the limit.
            limit_s: The limit, for the warning.
        """
        self._thread.join(within_s)
        if self._thread.is_alive():
            self._warn(f"no answer within {limit_s:g} s", "its last metrics may be missing there")
        if self._dropped:
            logger.warning("%s was too slow for %d rows, which are missing there", self._name, self._dropped)

    def _work(self) -> None:
        after = "going on without it"
        try:
            tracker = self._opening()
            self._idle()
            while (send := self._rows.get()) is not None:
                self._call("failed")
                send(tracker)
                self._idle()
            after = "its last metrics may be missing there"
            self._call("did not close")
            tracker.close()
        except BaseException as error:  # also SystemExit and the like: a tracker never stops training
            self._warn(_summary(error), after)

    def _call(self, problem: str) -> None:
        self._problem, self._since_s = problem, time.monotonic()

    def _idle(self) -> None:
        self._since_s = float("inf")

    def _warn(self, reason: str, after: str) -> None:
        if not self._warned:
            self._warned = True
            logger.warning("%s %s (%s); %s", self._name, self._problem, reason, after)


def _summary(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
