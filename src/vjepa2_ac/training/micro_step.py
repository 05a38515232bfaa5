"""The micro-step: losses of some clips, and their gradients added to those that are there; on request a CUDA graph.

At a few clips a GPU computes a micro-step faster than Python launches its 6,000 kernels. A CUDA graph
(`training.cuda_graph`) launches all of them at once: it is captured from the first batch, and replayed on each batch of
the same size. Batches of other sizes run without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from accelerate import Accelerator
from jaxtyping import Float
from torch import Tensor, nn

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.training.loss import Objective

MicroStep = Callable[[LatentBatch, float], Tensor]  # see `plain_micro_step`, without its first three arguments
Body = Callable[[], None]

_WARM_UPS = 3  # before a capture, in which nothing may be allocated for the first time: PyTorch's own advice


def plain_micro_step(
    objective: Objective, accelerator: Accelerator, scaler: torch.amp.GradScaler, latents: LatentBatch, parts: float
) -> Float[Tensor, 2]:
    """Return (teacher forcing, rollout), each a mean over these clips; add the gradient of their sum over `parts`."""
    with accelerator.autocast():
        forced, rollout = objective(latents)
    scaler.scale((forced + rollout) / parts).backward()
    return torch.stack([forced.detach(), rollout.detach()])


class GraphedMicroStep:
    """The same, captured once, and replayed where a batch has the sizes and the share of the first one.

    Args:
        plain: The micro-step to capture, and the fallback where the graph does not fit.
        trained: The parameters that receive gradients.
        capture: Records a body, and returns its replay: `captured`.
    """

    def __init__(self, plain: MicroStep, trained: Sequence[nn.Parameter], capture: Callable[[Body], Body]) -> None:
        self._plain, self._trained, self._capture = plain, trained, capture
        self._recorded: _Recorded | None = None

    def __call__(self, latents: LatentBatch, parts: float) -> Float[Tensor, 2]:
        """Do what `plain_micro_step` does."""
        its = self._recorded = self._recorded or self._record(latents, parts)
        new, own = _tensors(latents), _tensors(its.latents)
        if parts != its.parts or [one.shape for one in new.values()] != [one.shape for one in own.values()]:
            return self._plain(latents, parts)
        for name, value in own.items():
            value.copy_(new[name])
        self._hold(its.gradients)
        its.replay()
        return its.losses.clone()  # the next replay overwrites it

    def _record(self, latents: LatentBatch, parts: float) -> _Recorded:
        """Capture a micro-step on copies of these clips; gradients are as before afterwards."""
        copies: dict[str, Any] = {name: one.clone() for name, one in _tensors(latents).items()}
        given, losses = replace(latents, **copies), torch.zeros(2, device=latents.latents.device)
        before = [parameter.grad for parameter in self._trained]
        for parameter in self._trained:
            parameter.grad = None  # the graph gets tensors of its own

        def body() -> None:
            losses.copy_(self._plain(given, parts))

        replay = self._capture(body)
        gradients = [parameter.grad for parameter in self._trained]
        for parameter, gradient in zip(self._trained, before, strict=True):
            parameter.grad = gradient
        return _Recorded(given, parts, losses, gradients, replay)

    def _hold(self, gradients: Sequence[Tensor | None]) -> None:
        """Let the graph's own tensors be the gradients again: between steps the optimizer lets go of them."""
        fresh = []
        for parameter, own in zip(self._trained, gradients, strict=True):
            if own is None or parameter.grad is own:  # None: no clip reaches it
                continue
            if parameter.grad is None:
                fresh.append(own)
            else:
                own.copy_(parameter.grad)
            parameter.grad = own
        if fresh:
            torch._foreach_zero_(fresh)


@dataclass(frozen=True)
class _Recorded:
    """What a graph reads and writes, always at the same addresses."""

    latents: LatentBatch
    parts: float
    losses: Tensor
    gradients: Sequence[Tensor | None]
    replay: Body


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
