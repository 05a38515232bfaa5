"""What this machine has: GPU, memory, disk and cores."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vjepa2_ac import storage
from vjepa2_ac.training.cost.memory import GIGABYTE, USUAL_GPU


@dataclass(frozen=True)
class Machine:
    """What a run may use."""

    gpu: str | None
    gpu_bytes: int  # of a usual one, where there is none
    has_bf16: bool  # the GPU
    cores: int
    free_bytes: int  # of the disk where runs and caches go
    flops: float | None = None  # operations a second of the GPU's products, measured

    @property
    def precision(self) -> Literal["bf16", "fp16", "fp32"]:
        """In what it computes best: on a CPU without instructions for it bf16 is many times slower than fp32."""
        if self.gpu is None:
            return "fp32"
        return "bf16" if self.has_bf16 else "fp16"

    @property
    def room(self) -> str:
        """The memory that a batch has to fit on."""
        return f"{self.gpu_bytes / GIGABYTE:.1f} GB" + ("" if self.gpu else ", a usual GPU's")

    @property
    def about(self) -> str:
        """It in a line."""
        size = f"{self.gpu_bytes / GIGABYTE:.1f} GB"
        gpu = f"{self.gpu}, {size}" if self.gpu else "no GPU"
        return f"{gpu}; {self.cores} cores; {self.free_bytes / GIGABYTE:.0f} GB of disk free"


def duration(hours: float) -> str:
    """Return a time for people: hours, or minutes."""
    if hours >= 1:
        return f"about {hours:,.1f} hours"
    minutes = max(1, round(60 * hours))
    return f"about {minutes} minute{'s' if minutes > 1 else ''}"


def this_machine() -> Machine:
    """Return what this machine has."""
    import torch

    from vjepa2_ac.distributed import cuda_index, has_bf16, matmul_speed

    cores, free = len(os.sched_getaffinity(0)), storage.free_bytes(Path.cwd())
    if not torch.cuda.is_available():
        return Machine(None, USUAL_GPU, False, cores, free)
    device = torch.device("cuda", cuda_index())
    card, dtype = torch.cuda.get_device_properties(device), torch.bfloat16 if has_bf16() else torch.float16
    return Machine(card.name, card.total_memory, has_bf16(), cores, free, matmul_speed(device, dtype))
