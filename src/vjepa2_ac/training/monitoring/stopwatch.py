"""The stopwatch for waiting time: by the host's clock, or by the idle time of a CUDA device."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Protocol, runtime_checkable

import torch

from vjepa2_ac.data.clips.streams import Cuda


@runtime_checkable
class Stopwatch(Protocol):
    """Adds up how long waiting took."""

    @property
    def seconds(self) -> float:
        """So far."""
        ...

    def running(self) -> AbstractContextManager[None]:
        """Measure as long as the context lasts."""
        ...


class HostStopwatch:
    """Measures what the host waits."""

    def __init__(self) -> None:
        self.seconds = 0.0

    @contextmanager
    def running(self) -> Iterator[None]:
        """Measure as long as the context lasts."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds += time.perf_counter() - started


class IdleStopwatch:
    """Measures what a CUDA device stands idle while the host waits: between the end of what it had to do and the next.

    Args:
        cuda: The device.
    """

    def __init__(self, cuda: Cuda) -> None:
        self._cuda = cuda
        self._spans: deque[tuple[Any, Any]] = deque()  # events that the device may not have come to yet
        self._seconds = 0.0

    @property
    def seconds(self) -> float:
        """So far; waiting that the device has not come to yet counts when it has. Nothing waits for it."""
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
    """Return what measures the waiting for data where a run computes."""
    return IdleStopwatch(Cuda(device)) if device.type == "cuda" else HostStopwatch()
