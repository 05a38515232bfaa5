"""The micro-step: losses of some clips, and their gradients added to the existing ones; optionally as a CUDA graph.

At one or two clips a GPU finishes a micro-step faster than Python launches its 6,000 kernels. A CUDA graph
(`training.cuda_graph`) launches all of them at once: it is captured from the first batch, with its shapes and
addresses, and replayed on each batch of the same size. Other batches run without a graph.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from accelerate import Accelerator
from jaxtyping import Float
from torch import Tensor, nn

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.training.loss import Objective

Body = Callable[[], None]
Capture = Callable[[Body], Body]  # turns a body into one that repeats it

_WARM_UPS = 3  # before a capture, in which nothing may be allocated for the first time: PyTorch's own advice


class MicroStep:
    """Computes losses and adds gradients in plain PyTorch."""

    def __init__(self, objective: Objective, accelerator: Accelerator, scaler: torch.amp.GradScaler) -> None:
        self._objective, self._accelerator, self._scaler = objective, accelerator, scaler

    def __call__(self, latents: LatentBatch, parts: float) -> Float[Tensor, 2]:
        """Return (teacher forcing, rollout), each a mean over these clips; add the gradient of their sum.

        Args:
            latents: The clips, on the device.
            parts: Number of micro-steps of this size in the step: the gradient is divided by it.
        """
        with self._accelerator.autocast():
            forced, rollout = self._objective(latents)
        self._scaler.scale((forced + rollout) / parts).backward()
        return torch.stack([forced.detach(), rollout.detach()])


class CapturedMicroStep:
    """The same, captured once and replayed if a batch has the sizes and the share of the first one.

    Gradients must keep their addresses: they are zeroed between steps, never freed.

    Args:
        plain: The micro-step to capture, and the fallback if the graph does not fit.
        trained: The parameters that receive gradients.
        capture: Records a body without running it, and returns its replay.
    """

    def __init__(self, plain: MicroStep, trained: Sequence[nn.Parameter], capture: Capture) -> None:
        self._plain, self._trained, self._capture = plain, trained, capture
        self._given: tuple[LatentBatch, float] | None = None  # input of the graph
        self._losses: Tensor | None = None  # output of the graph
        self._replay: Body | None = None

    def __call__(self, latents: LatentBatch, parts: float) -> Float[Tensor, 2]:
        """Do the same as `MicroStep`."""
        if self._replay is None or self._losses is None or self._given is None:
            self._record(latents, parts)
            return self(latents, parts)
        if parts != self._given[1] or _shapes(latents) != _shapes(self._given[0]):
            return self._plain(latents, parts)
        new = _tensors(latents)
        for name, own in _tensors(self._given[0]).items():
            own.copy_(new[name])
        self._replay()
        return self._losses.clone()  # the next replay overwrites it

    def _record(self, latents: LatentBatch, parts: float) -> None:
        """Capture a micro-step on copies of these clips; gradients are restored afterwards."""
        copies: dict[str, Any] = {name: one.clone() for name, one in _tensors(latents).items()}
        given = replace(latents, **copies)
        losses = torch.zeros(2, device=latents.latents.device)

        def body() -> None:
            losses.copy_(self._plain(given, parts))

        before = [None if one.grad is None else one.grad.clone() for one in self._trained]
        self._replay = self._capture(body)
        for parameter, gradient in zip(self._trained, before, strict=True):
            if parameter.grad is not None:  # a parameter that no clip reaches has none
                parameter.grad.zero_() if gradient is None else parameter.grad.copy_(gradient)
        self._given, self._losses = (given, parts), losses


def captured_on_cuda(body: Body) -> Body:
    """Record the kernels of a body, after running it a few times, and return their replay.

    Source: PyTorch's notes on CUDA graphs, "Whole-network capture": warm-up and capture on a side stream.
    """
    side = torch.cuda.Stream()  # type: ignore[no-untyped-call]  # torch
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(_WARM_UPS):
            body()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):  # the loader's thread pins memory meanwhile
        body()
    replay: Body = graph.replay
    return replay


def _tensors(latents: LatentBatch) -> dict[str, Tensor]:
    return {name: value for name, value in vars(latents).items() if isinstance(value, Tensor)}


def _shapes(latents: LatentBatch) -> dict[str, Any]:
    return {name: (value.shape, value.dtype) for name, value in _tensors(latents).items()}
