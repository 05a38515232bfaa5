"""Measure peak memory in isolation: on CUDA after releasing all other memory, else in a new process.

On CUDA the peak of PyTorch's allocator is measured, on a CPU the resident memory.
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
from rows import describe_failure

_SETTINGS = ("PYTORCH_ALLOC_CONF", "PYTORCH_CUDA_ALLOC_CONF")  # the second is the name before PyTorch 2.9
_EXPANDABLE = "expandable_segments:True"


def use_expandable_segments() -> None:
    """Let PyTorch's allocator extend its memory segments, which avoids fragmentation.

    Settings of the allocator in the environment are not changed. Must be called before the first allocation on the
    device.
    """
    if not any(map(os.environ.get, _SETTINGS)):
        os.environ[_SETTINGS[0]] = _EXPANDABLE  # for child processes
        torch._C._accelerator_setAllocatorSettings(_EXPANDABLE)  # PyTorch has read the environment at its import


def release_memory(device: str) -> None:
    """Free memory that is no longer referenced."""
    gc.collect()
    if device != "cpu":
        torch.cuda.empty_cache()


def count_alloc_retries(device: str) -> int:
    """Return how often the allocator had to release its unused memory before an allocation succeeded; 0 on a CPU."""
    return 0 if device == "cpu" else int(torch.cuda.memory_stats().get("num_alloc_retries", 0))


def is_expandable(device: str) -> bool | None:
    """Return whether the allocator can extend its memory segments; None on a CPU."""
    return None if device == "cpu" else any(segment["is_expandable"] for segment in torch.cuda.memory_snapshot())


@contextmanager
def limit_memory(gigabytes: float, device: str) -> Iterator[None]:
    """Limit the memory of a GPU within the context, in 10^9 bytes; 0: no limit."""
    if not gigabytes or device == "cpu":
        yield
        return
    total_bytes = torch.cuda.get_device_properties(device).total_memory
    release_memory(device)
    torch.cuda.set_per_process_memory_fraction(min(1.0, gigabytes * 1e9 / total_bytes))
    try:
        yield
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)


def measure_peak_gb(work: Callable[[], object], device: str) -> float:
    """Run a computation twice, and return the peak memory in 10^9 bytes, including all objects that exist already."""
    release_memory(device)
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats()
    else:
        with suppress(OSError):  # resets VmHWM, if the system supports it
            Path("/proc/self/clear_refs").write_text("5")
    work()
    work()  # the optimizer's moments exist from the second training step on
    if device != "cpu":
        return torch.cuda.max_memory_allocated() / 1e9
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) * 1024 / 1e9


def measure_peak_alone(
    measure: Callable[[], float], command: Sequence[str], device: str, cap_gb: float = 0.0
) -> dict[str, Any]:
    """Measure the peak memory of a computation alone, and return the fields of a row: the peak, and the problem if any.

    Args:
        measure: Builds the computation and returns its peak; used on CUDA. The device must hold nothing else.
        command: A benchmark and arguments that print the same number in their last line; used on a CPU.
        device: The device, such as cuda.
        cap_gb: Limit of the GPU memory in 10^9 bytes; 0: no limit.
    """
    row: dict[str, Any] = {"peak_gb": None, "problem": None}
    release_memory(device)
    try:
        with limit_memory(cap_gb, device):
            row["peak_gb"] = measure_in_new_process(command) if device == "cpu" else measure()
    except Exception as error:
        row["problem"] = describe_failure(error)
    release_memory(device)
    return row


def measure_in_new_process(command: Sequence[str]) -> float:
    """Run a benchmark in a new process, and return the number in its last line of output.

    Raises:
        RuntimeError: The process failed.
    """
    process = subprocess.run([sys.executable, *command], check=False, capture_output=True, text=True)  # noqa: S603
    if process.returncode:
        sys.stderr.write(process.stderr)
        last_line = (process.stderr.strip().splitlines() or ["no error output"])[-1]
        raise RuntimeError(f"the benchmark process exited with {process.returncode}: {last_line}")
    return float(json.loads(process.stdout.splitlines()[-1]))
