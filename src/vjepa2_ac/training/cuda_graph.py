"""The micro-step as a CUDA graph (`training.cuda_graph`).

At a few clips a GPU computes a micro-step faster than Python launches its 6,000 kernels. A CUDA graph launches all of
them at once: it is captured from the first batch, and replayed on each batch of the same size. Batches of other sizes
run without it.
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

_WARM_UPS = 3  # before a capture, in which nothing may be allocated for the first time: PyTorch's own advice


class GraphedMicroStep:
    """A micro-step that is captured once, and replayed where a batch has the sizes and the share of the first one.

    Args:
        capture: Records a body, and returns its replay; None: `captured`.
    """

    def __init__(self, capture: Callable[[Body], Body] | None = None) -> None:
        self._capture = capture or captured
        self._graph: _Graph | None = None

    def __call__(self, run: Run, latents: LatentBatch, parts: float) -> Float[Tensor, 2]:
        """Do what `step.micro_step` does."""
        graph = self._graph = self._graph or self._record(run, latents, parts)
        new, static = _tensors(latents), _tensors(graph.latents)
        if parts != graph.parts or [one.shape for one in new.values()] != [one.shape for one in static.values()]:
            return micro_step(run, latents, parts)
        for name, value in static.items():
            value.copy_(new[name])
        _restore(run.trained, graph.gradients)
        graph.replay()
        return graph.losses.clone()  # the next replay overwrites it

    def _record(self, run: Run, latents: LatentBatch, parts: float) -> _Graph:
        """Capture a micro-step on copies of these clips; gradients are as before afterwards."""
        copies: dict[str, Any] = {name: one.clone() for name, one in _tensors(latents).items()}
        static, losses = replace(latents, **copies), torch.zeros(2, device=latents.latents.device)
        before = [parameter.grad for parameter in run.trained]
        for parameter in run.trained:
            parameter.grad = None  # the graph gets tensors of its own

        def body() -> None:
            losses.copy_(micro_step(run, static, parts))

        replay = self._capture(body)
        gradients = [parameter.grad for parameter in run.trained]
        for parameter, gradient in zip(run.trained, before, strict=True):
            parameter.grad = gradient
        return _Graph(static, parts, losses, gradients, replay)


@dataclass(frozen=True)
class _Graph:
    """What a graph reads and writes, always at the same addresses."""

    latents: LatentBatch
    parts: float
    losses: Tensor
    gradients: Sequence[Tensor | None]
    replay: Body


def _restore(trained: Sequence[nn.Parameter], gradients: Sequence[Tensor | None]) -> None:
    """Set `.grad` back to the graph's static tensors: `zero_grad` has set it to None."""
    fresh = []
    for parameter, static in zip(trained, gradients, strict=True):
        if static is None or parameter.grad is static:  # None: no clip reaches the parameter
            continue
        if parameter.grad is None:
            fresh.append(static)
        else:
            static.copy_(parameter.grad)
        parameter.grad = static
    if fresh:
        torch._foreach_zero_(fresh)


def captured(body: Body) -> Body:
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
