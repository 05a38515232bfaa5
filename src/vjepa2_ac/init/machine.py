"""What this machine has: GPU, memory, disk, cores, and how fast a file of the data comes."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vjepa2_ac import storage
from vjepa2_ac.errors import UserError
from vjepa2_ac.training.cost.memory import GIGABYTE, USUAL_GPU

_SAMPLE_BYTES = 8 << 20
_LEAST_BYTES = 1 << 20  # a smaller file says how long an answer takes, not how fast data come
_USUAL_BYTES_PER_S = 100e6 / 8  # 100 Mbit/s: assumed


@dataclass(frozen=True)
class Machine:
    """What a run may use."""

    gpu: str | None
    gpu_bytes: int  # of a usual one, where there is none
    has_bf16: bool  # the GPU
    cores: int
    free_bytes: int  # of the disk where runs and caches go
    read_bytes_per_s: float | None = None  # of one file of the data, behind a URL
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
        network = f"; network: {self.read_bytes_per_s / 1e6:.1f} MB/s" if self.read_bytes_per_s else ""
        return f"{gpu}; {self.cores} cores; {self.free_bytes / GIGABYTE:.0f} GB of disk free{network}"

    def time_to_fetch(self, size: float) -> str:
        """Return how long so many bytes take: at the speed of the data's file, or else at an assumed one."""
        if speed := self.read_bytes_per_s:
            return f"{duration(size / speed / 3600)} at the data's {speed / 1e6:.1f} MB/s"
        return f"{duration(size / _USUAL_BYTES_PER_S / 3600)} at 100 Mbit/s"


def duration(hours: float) -> str:
    """Return a time for people: hours, or minutes."""
    if hours >= 1:
        return f"about {hours:,.1f} hours"
    minutes = max(1, round(60 * hours))
    return f"about {minutes} minute{'s' if minutes > 1 else ''}"


def this_machine(sample: str = "") -> Machine:
    """Return what this machine has.

    Args:
        sample: A large file behind a URL, of which some megabytes are read to see how fast it comes; empty: none.
    """
    import torch

    from vjepa2_ac.distributed import cuda_index, has_bf16, matmul_speed

    cores, free = len(os.sched_getaffinity(0)), storage.free_bytes(Path.cwd())
    speed = _speed_of(sample) if sample else None
    if not torch.cuda.is_available():
        return Machine(None, USUAL_GPU, False, cores, free, speed)
    device = torch.device("cuda", cuda_index())
    card, dtype = torch.cuda.get_device_properties(device), torch.bfloat16 if has_bf16() else torch.float16
    return Machine(card.name, card.total_memory, has_bf16(), cores, free, speed, matmul_speed(device, dtype))


def _speed_of(sample: str) -> float | None:
    """Return bytes per second of one read; None of a small file, or where it fails: the check of the data says why."""
    try:
        size = min(_SAMPLE_BYTES, storage.file_size(sample))
        if size < _LEAST_BYTES:
            return None
        started = time.perf_counter()
        storage.read_range(sample, 0, size)
    except (OSError, UserError):
        return None
    return size / max(1e-6, time.perf_counter() - started)
