"""The stopwatch for waiting time: by the host's clock, or by the idle time of a CUDA device."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from vjepa2_ac.data.streams import Cuda


class Stopwatch:
    """Sums up waiting time: of the host, by its own clock."""

    def __init__(self) -> None:
        self._seconds = 0.0

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return self._seconds

    @contextmanager
    def running(self) -> Iterator[None]:
        """Measure as long as the context lasts."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self._seconds += time.perf_counter() - started


class IdleStopwatch(Stopwatch):
    """Measures the idle time of a CUDA device while the host waits: from the end of its queued work to the next work.

    Args:
        cuda: The device.
    """

    def __init__(self, cuda: Cuda) -> None:
        super().__init__()
        self._cuda = cuda
        self._spans: deque[tuple[Any, Any]] = deque()  # events that the device may not have reached yet

    @property
    def seconds(self) -> float:
        """Seconds so far; waiting that the device has not reached yet counts later. Does not synchronize."""
        while self._spans and self._spans[0][1].query():
            began, ended = self._spans.popleft()
            self._seconds += began.elapsed_time(ended) / 1000
        return self._seconds

    @contextmanager
    def running(self) -> Iterator[None]:
        """Measure as long as the context lasts."""
        began = self._cuda.timestamp()
        try:
            yield
        finally:
            self._spans.append((began, self._cuda.timestamp()))


def stopwatch_for(device: torch.device) -> Stopwatch:
    """Return the stopwatch for the device of a run."""
    return IdleStopwatch(Cuda(device)) if device.type == "cuda" else Stopwatch()
