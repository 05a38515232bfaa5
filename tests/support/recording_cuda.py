"""A fake CUDA device: copies are done at once, and calls are recorded in order."""

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
import torch

from vjepa2_ac.data.streams import Cuda

COMPUTING = "computing"


@dataclass
class RecordingCuda(Cuda):
    """Takes the place of `vjepa2_ac.data.streams.Cuda`: streams have names, and events numbers."""

    calls: list[str] = field(default_factory=list)
    streams: int = 0
    events: int = 0
    now: str = COMPUTING  # the stream that is enqueued on

    def new_stream(self) -> "RecordedStream":
        self.streams += 1
        return RecordedStream(self, f"side {self.streams}")

    def computing(self) -> "RecordedStream":
        return RecordedStream(self, COMPUTING)

    @contextlib.contextmanager
    def on(self, stream: "RecordedStream") -> Iterator[None]:
        before, self.now = self.now, stream.name
        yield
        self.now = before

    def to_device(self, pinned: torch.Tensor) -> torch.Tensor:
        self.calls.append(f"{self.now}: to device")
        return pinned.clone()

    def pinned_copy(self, tensor: torch.Tensor) -> torch.Tensor:
        self.calls.append(f"{self.now}: to pinned memory")
        return tensor.clone()

    def used_by(self, tensor: torch.Tensor, stream: "RecordedStream") -> None:
        del tensor
        self.calls.append(f"memory in use by {stream.name}")


@dataclass
class RecordedStream:
    cuda: RecordingCuda
    name: str

    def record_event(self) -> "RecordedEvent":
        self.cuda.events += 1
        self.cuda.calls.append(f"{self.name}: event {self.cuda.events}")
        return RecordedEvent(self.cuda, self.cuda.events)

    def wait_event(self, event: "RecordedEvent") -> None:
        self.cuda.calls.append(f"{self.name}: waits for event {event.number}")


@dataclass
class RecordedEvent:
    cuda: RecordingCuda
    number: int


class Pinning:
    """Lets this process believe in a CUDA device as far as a DataLoader pins for it, and knows what was pinned."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.pinned: list[torch.Tensor] = []
        self.threads: set[str] = set()
        patch.setattr(torch.accelerator, "is_available", lambda: True)
        patch.setattr(torch.accelerator, "current_accelerator", lambda: torch.device("cuda"))
        patch.setattr(torch.accelerator, "current_device_index", lambda: 0)
        patch.setattr(torch.accelerator, "set_device_index", lambda _: None)
        patch.setattr(torch.Tensor, "pin_memory", lambda tensor: self._pin(tensor))
        patch.setattr(torch.Tensor, "is_pinned", lambda tensor: any(tensor is one for one in self.pinned))

    def _pin(self, tensor: torch.Tensor) -> torch.Tensor:
        self.pinned.append(tensor.clone())
        self.threads.add(threading.current_thread().name)
        return self.pinned[-1]
