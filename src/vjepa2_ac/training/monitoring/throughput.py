"""Training and throughput metrics of one optimizer step, for the metrics log and the console.

update_to_weight    norm of the update over the norm of the weights before it, of all that is trained together
data_wait_share     share of the step's wall time spent waiting for the loader; on CUDA only the device's idle time,
                    since it computes queued work while the host waits
samples_per_second  clips, of all processes
tokens_per_second   patch tokens of the frames of these clips
mfu                 model FLOPs per second (`training.cost.flops`) over the ceiling: the rate of this device in a large
                    matrix product in the run's precision, measured for a fraction of a second at the start
memory_gb           peak so far in 10^9 bytes: of PyTorch's allocator on CUDA, resident elsewhere
"""

from __future__ import annotations

import math
import resource
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributed.tensor import DTensor

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.data.loader import prefetch_next
from vjepa2_ac.distributed.device import PRECISIONS, matmul_speed
from vjepa2_ac.episode import Batch
from vjepa2_ac.training.cost.flops import clip_flops
from vjepa2_ac.training.monitoring.stopwatch import Stopwatch

MEASURED = frozenset({"data_wait_share", "samples_per_second", "tokens_per_second", "mfu", "memory_gb"})
"""Metrics of the machine: they differ between identical runs."""


class TimedBatches:
    """Passes on batches, and measures how long the loader was waited for, also for prefetched ones.

    Args:
        batches: The loader's.
        stopwatch: Measures the waiting time; None: by the host's clock.
    """

    def __init__(self, batches: Iterator[Batch], stopwatch: Stopwatch | None = None) -> None:
        self._batches, self._stopwatch = batches, stopwatch or Stopwatch()

    @property
    def waited_s(self) -> float:
        """Total waiting time in seconds."""
        return self._stopwatch.seconds

    def __iter__(self) -> TimedBatches:
        """Return itself."""
        return self

    def __next__(self) -> Batch:
        """Return the next batch."""
        with self._stopwatch.running():
            return next(self._batches)

    def prefetch_next(self) -> None:
        """Fetch the next batch in advance, if the loader can."""
        with self._stopwatch.running():
            prefetch_next(self._batches)


@dataclass(frozen=True)
class Throughput:
    """Turns a step's clips and seconds into metrics."""

    flops_per_clip: int
    tokens_per_clip: int
    ceiling: float  # FLOPs per second of all processes
    device: torch.device

    @classmethod
    def of(
        cls, config: Config, sizes: ModelSizes, device: torch.device, processes: int, *, encodes: bool = True
    ) -> Throughput:
        """Measure the ceiling, once per device, precision and program.

        Args:
            config: The run.
            sizes: Of its model.
            device: Of this process.
            processes: Of the run.
            encodes: Whether the encoder's work counts; cached latents need none.
        """
        tokens = config.data.frames * sizes.tokens_per_frame
        ceiling = processes * matmul_speed(device, PRECISIONS[config.training.precision])
        flops = clip_flops(config, sizes)
        return cls(flops.total if encodes else flops.predictor, tokens, ceiling, device)

    def metrics(self, clips: float, seconds: float, waited_s: float) -> dict[str, float]:
        """Return the metrics of one step.

        Args:
            clips: Of all processes.
            seconds: The step's wall time.
            waited_s: The part of it spent waiting for the loader.
        """
        return {
            "samples_per_second": clips / seconds,
            "tokens_per_second": clips * self.tokens_per_clip / seconds,
            "data_wait_share": min(1.0, waited_s / seconds),
            "mfu": clips * self.flops_per_clip / seconds / self.ceiling,
            "memory_gb": peak_memory_gb(self.device),
        }

    def __str__(self) -> str:
        return (
            f"A clip takes {self.flops_per_clip / 1e12:.3g} TFLOP; the ceiling for mfu is {self.ceiling / 1e12:.3g}"
            f" TFLOP/s, measured on {self.device.type} now"
        )


class Update:
    """Measures how far an optimizer step moves the weights. Keeps a copy of them until it is read.

    If weights are sharded over processes, each of them has to create and read one.

    Args:
        parameters: Those of the optimizer, before the step.
    """

    def __init__(self, parameters: Iterable[Tensor]) -> None:
        self._parameters = list(parameters)
        self._before = [parameter.detach().clone() for parameter in self._parameters]

    def to_weight(self) -> float:
        """Return the norm of the update over that of the weights before it, of all tensors together; read it once."""
        weight = _norm(self._before)
        for before, parameter in zip(self._before, self._parameters, strict=True):
            before -= parameter.detach()  # in the copy's own memory
        return _norm(self._before) / weight if weight else math.nan


def peak_memory_gb(device: torch.device) -> float:
    """Return the peak so far: of PyTorch's allocator on CUDA, of this process's resident memory elsewhere."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9  # Linux counts in KiB


def _norm(tensors: list[Tensor]) -> float:
    norm = torch.nn.utils.get_total_norm(tensors)
    return float(norm.full_tensor() if isinstance(norm, DTensor) else norm)
