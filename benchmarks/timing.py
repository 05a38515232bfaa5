"""How long, and in how much memory? Ways to do one thing take turns, so that a busy machine slows them alike.

On a CPU the process's own time over its threads counts, else wall time.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import torch

WAITS = {"cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize"}  # as PyTorch's profiler calls them
BESIDE = Path(__file__).resolve().parents[2] / "vjepa2"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what every benchmark beside the official code takes: where, how often, against which checkout."""
    parser.add_argument("--quick", action="store_true", help="tiny sizes: whether it works")
    parser.add_argument("--official", type=Path, default=BESIDE, help="checkout (default: vjepa2 beside this project)")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--warm-up", type=int, default=1, help="rounds that do not count")
    parser.add_argument("--threads", type=int, default=0, help="0: as torch chooses")
    parser.add_argument("--memory", action=argparse.BooleanOptionalAction, default=True, help="measure peak memory too")


def take_turns(steps: dict[str, Callable[[], object]], options: argparse.Namespace) -> dict[str, list[float]]:
    """Return the seconds of each repeat of each way; rounds to warm up do not count."""
    times: dict[str, list[float]] = {way: [] for way in steps}
    for repeat in range(options.warm_up + options.repeats):
        for way, step in steps.items():
            start = clock_s(options.device)
            step()
            if repeat >= options.warm_up:
                times[way].append(clock_s(options.device) - start)
    return times


def peak_memory_gb(work: Callable[[], object], device: str) -> float:
    """Return the peak in 10^9 bytes of doing something twice: on CUDA of PyTorch's allocator, else resident."""
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


def in_own_process(script: str, arguments: Sequence[str]) -> float:
    """Return the number that a benchmark prints in a fresh process, in its last line."""
    command = [sys.executable, script, *arguments]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)  # noqa: S603
    return float(json.loads(done.stdout.splitlines()[-1]))


def clock_s(device: str) -> float:
    """Return seconds that a machine shared with others does not add to, as far as that can be."""
    if device == "cpu":
        return time.process_time() / torch.get_num_threads()
    torch.cuda.synchronize()
    return time.perf_counter()


def device_name(device: str) -> str:
    """Return what computes."""
    if device != "cpu":
        return torch.cuda.get_device_name()
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "CPU")
