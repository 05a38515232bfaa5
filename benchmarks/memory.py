"""Measure peak memory in isolation: on CUDA after releasing all other memory, else in a new process.

On CUDA the peak is that of PyTorch's allocator, on a CPU what is resident.
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from rows import problem_of

_SETTINGS = ("PYTORCH_ALLOC_CONF", "PYTORCH_CUDA_ALLOC_CONF")  # the second is what it was called before 2.9
_EXPANDABLE = "expandable_segments:True"


def use_expandable_segments() -> None:
    """Let PyTorch's allocator grow what it has instead of keeping blocks of sizes that others cannot use.

    Where the environment says something of the allocator, that stays. To be called before anything is on the device.
    PyTorch built for CUDA reads the environment when it is imported, so it is told as well.
    """
    if not any(map(os.environ.get, _SETTINGS)):
        os.environ[_SETTINGS[0]] = _EXPANDABLE
        torch._C._accelerator_setAllocatorSettings(_EXPANDABLE)


def let_go(device: str) -> None:
    """Give back what nothing refers to any more."""
    gc.collect()
    if device != "cpu":
        torch.cuda.empty_cache()


def alloc_retries(device: str) -> int:
    """Return how often the allocator found nothing, and gave all its unused memory back to try again."""
    return 0 if device == "cpu" else int(torch.cuda.memory_stats().get("num_alloc_retries", 0))


def is_expandable(device: str) -> bool | None:
    """Return whether the allocator can grow what it has; None where that is no question."""
    return None if device == "cpu" else any(segment["is_expandable"] for segment in torch.cuda.memory_snapshot())


@contextmanager
def capped(gigabytes: float, device: str) -> Iterator[None]:
    """Let no more than so many 10^9 bytes of the device be used for a while; 0: all."""
    if not gigabytes or device == "cpu":
        yield
        return
    whole = torch.cuda.get_device_properties(device).total_memory
    let_go(device)
    torch.cuda.set_per_process_memory_fraction(min(1.0, gigabytes * 1e9 / whole))
    try:
        yield
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)


def peak_gb(work: Callable[[], object], device: str) -> float:
    """Return the peak in 10^9 bytes of doing something twice, with what is there already."""
    let_go(device)
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats()
    else:
        with suppress(OSError):  # where the system has it: what building the model took is forgotten
            Path("/proc/self/clear_refs").write_text("5")
    work()
    work()  # of a training step: with the optimizer's moments
    if device != "cpu":
        return torch.cuda.max_memory_allocated() / 1e9
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) * 1024 / 1e9


def peak_alone(
    measure: Callable[[], float], command: Sequence[str], device: str, cap_gb: float = 0.0
) -> dict[str, Any]:
    """Return what a row holds of the peak of something with nothing else in memory, or what came in between.

    Args:
        measure: Builds what is measured, and returns its peak; for CUDA, where nothing else may be on the device.
        command: A benchmark and arguments that print the same number in their last line; for a CPU.
        device: Where.
        cap_gb: 10^9 bytes that may be used; 0: all.
    """
    row: dict[str, Any] = {"peak_gb": None, "problem": None}
    let_go(device)
    try:
        with capped(cap_gb, device):
            row["peak_gb"] = in_own_process(command) if device == "cpu" else measure()
    except Exception as error:
        row["problem"] = problem_of(error)
    let_go(device)
    return row


def in_own_process(command: Sequence[str]) -> float:
    """Return the number that a benchmark prints in a fresh process, in its last line.

    Raises:
        RuntimeError: It failed; says how.
    """
    done = subprocess.run([sys.executable, *command], check=False, capture_output=True, text=True)  # noqa: S603
    if done.returncode:
        sys.stderr.write(done.stderr)
        last = (done.stderr.strip().splitlines() or ["it says nothing"])[-1]
        raise RuntimeError(f"a process of its own ended with {done.returncode}: {last}")
    return float(json.loads(done.stdout.splitlines()[-1]))
