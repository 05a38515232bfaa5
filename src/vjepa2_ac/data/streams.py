"""Asynchronous copies of batches to the device: an own CUDA stream and pinned memory, while the device computes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeVar

import torch
from torch import Tensor

_T = TypeVar("_T")
Change = Callable[[Tensor], Tensor]


class Cuda:
    """The functions of a CUDA device besides computing; tests replace it by a recording fake.

    Streams and events are PyTorch's.

    Args:
        device: The device.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device

    def new_stream(self) -> Any:
        """Return a new stream, separate from the computing one."""
        return torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]  # torch

    def computing(self) -> Any:
        """Return the computing stream."""
        return torch.cuda.current_stream(self._device)

    def on(self, stream: Any) -> contextlib.AbstractContextManager[object]:
        """Enqueue work on a stream within the context."""
        return torch.cuda.stream(stream)

    def to_device(self, pinned: Tensor) -> Tensor:
        """Enqueue the copy of a pinned tensor to the device, and return the copy."""
        return pinned.to(self._device, non_blocking=True)

    def pinned_copy(self, tensor: Tensor) -> Tensor:
        """Return a copy in pinned memory."""
        return tensor.pin_memory()

    def used_by(self, tensor: Tensor, stream: Any) -> None:
        """Reserve the memory of a tensor until a stream other than its own has finished with it."""
        tensor.record_stream(stream)

    def timestamp(self) -> Any:
        """Enqueue an event with time on the computing stream, and return it."""
        event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]  # torch
        event.record(self.computing())
        return event


class ToDevice:
    """Copies tensors to the device, on its own stream. Only the computation that uses the copies waits.

    Unpinned tensors are pinned first: a copy from other memory would block the host.

    Args:
        cuda: The device.
    """

    def __init__(self, cuda: Cuda) -> None:
        self._cuda, self._stream = cuda, cuda.new_stream()

    def start(self, mapped: Callable[[Change], _T]) -> Callable[[], _T]:
        """Start to copy tensors, and return a function that returns the copies.

        That function lets the computing stream, not the host, wait for them.

        Args:
            mapped: Replaces each of the tensors, such as `Batch.mapped`; called once, immediately.
        """
        cuda, copies = self._cuda, list[Tensor]()

        def copy(tensor: Tensor) -> Tensor:
            copies.append(cuda.to_device(tensor if tensor.is_pinned() else cuda.pinned_copy(tensor)))
            return copies[-1]

        with cuda.on(self._stream):
            moved = mapped(copy)
        done = self._stream.record_event()

        def taken() -> _T:
            computing = cuda.computing()
            computing.wait_event(done)
            for tensor in copies:
                cuda.used_by(tensor, computing)
            return moved

        return taken


@lru_cache(maxsize=8)
def copies_for(device: torch.device) -> ToDevice | None:
    """Return the copies to a device, always on the same stream; None: they would not overlap with computation."""
    return ToDevice(Cuda(device)) if device.type == "cuda" else None
