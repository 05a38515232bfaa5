"""The micro-step as a CUDA graph (`training.cuda_graph`).

With few clips per micro-step, a GPU computes the 6,000 kernels of the step faster than Python can launch them. A CUDA
graph launches all kernels at once: it is captured with the first batch, and replayed for each batch of the same size.
Batches of other sizes run without the graph.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.training.step import Run, micro_step

Body = Callable[[], None]

_WARM_UPS = 3  # runs before a capture, as PyTorch advises, because a capture must not initialise libraries


class GraphedMicroStep:
    """A micro-step that is captured with the first batch, and replayed for batches of the same size.

    A batch with other tensor sizes or another `loss_divisor` runs without the graph.

    Args:
        capture: Captures a function and returns a function that replays it; `capture_graph` if None.
    """

    def __init__(self, capture: Callable[[Body], Body] | None = None) -> None:
        self._capture = capture or capture_graph
        self._graph: _Graph | None = None

    def __call__(self, run: Run, latents: LatentBatch, loss_divisor: float) -> Float[Tensor, 2]:
        """Compute the same as `step.micro_step`."""
        graph = self._graph = self._graph or self._record(run, latents, loss_divisor)
        new, static = _tensors(latents), _tensors(graph.latents)
        if loss_divisor != graph.loss_divisor or [tensor.shape for tensor in new.values()] != [
            tensor.shape for tensor in static.values()
        ]:
            return micro_step(run, latents, loss_divisor)
        for name, value in static.items():
            value.copy_(new[name])
        _restore_gradients(run.trained, graph.gradients)
        graph.replay()
        return graph.losses.clone()  # a copy, because the next replay overwrites the tensor

    def _record(self, run: Run, latents: LatentBatch, loss_divisor: float) -> _Graph:
        """Capture a micro-step on copies of these clips, without changing the current gradients."""
        copies: dict[str, Any] = {name: tensor.clone() for name, tensor in _tensors(latents).items()}
        static, losses = replace(latents, **copies), torch.zeros(2, device=latents.latents.device)
        before = [parameter.grad for parameter in run.trained]
        for parameter in run.trained:
            parameter.grad = None  # the captured backward pass then allocates the static gradient tensors

        def body() -> None:
            losses.copy_(micro_step(run, static, loss_divisor))

        replay = self._capture(body)
        gradients = [parameter.grad for parameter in run.trained]
        for parameter, gradient in zip(run.trained, before, strict=True):
            parameter.grad = gradient
        return _Graph(static, loss_divisor, losses, gradients, replay)


@dataclass(frozen=True)
class _Graph:
    """A captured graph with the static tensors that it reads and writes."""

    latents: LatentBatch
    loss_divisor: float
    losses: Tensor
    gradients: Sequence[Tensor | None]
    replay: Body


def _restore_gradients(trained: Sequence[nn.Parameter], gradients: Sequence[Tensor | None]) -> None:
    """Move the accumulated gradients into the graph's static tensors; they are zero after `zero_grad`."""
    unset = []
    for parameter, static in zip(trained, gradients, strict=True):
        if static is None or parameter.grad is static:  # None: the loss does not depend on the parameter
            continue
        if parameter.grad is None:
            unset.append(static)
        else:
            static.copy_(parameter.grad)
        parameter.grad = static
    if unset:
        torch._foreach_zero_(unset)


def capture_graph(body: Body) -> Body:
    """Capture a function in a CUDA graph, after warm-up runs, and return the function that replays it.

    Source: PyTorch's notes on CUDA graphs, "Whole-network capture": warm-up and capture on a side stream.
    """
    side_stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]  # torch
    side_stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side_stream):
        for _ in range(_WARM_UPS):
            body()
    torch.cuda.current_stream().wait_stream(side_stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):  # the loader's thread may pin memory meanwhile
        body()
    replay: Body = graph.replay
    return replay


def _tensors(latents: LatentBatch) -> dict[str, Tensor]:
    return {name: value for name, value in vars(latents).items() if isinstance(value, Tensor)}
