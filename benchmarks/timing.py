"""Time variants of one computation. They take turns, so that load on the machine slows all of them equally.

On a CPU the process time divided by the number of threads is measured, otherwise wall time. A variant that fails is
reported and not repeated. On CUDA, a variant is discarded if the allocator had to release memory during its turns.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from memory import alloc_retries, use_expandable_segments
from rows import problem_of
from torch.profiler import ProfilerActivity, profile

WAITS_ON = {
    "cuda": {"cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize"},  # as the profiler calls them
    "cpu": {"aten::_local_scalar_dense"},  # of which some ask no device: only whether counting works
}
PROFILED_ROWS = 15
BESIDE = Path(__file__).resolve().parents[2] / "vjepa2"
_REPEATS = {"cuda": (10, 3), "cpu": (3, 1)}  # that count, and to warm up: a GPU's clock has to rise


def add_basics(parser: argparse.ArgumentParser) -> None:
    """Add the options of all benchmarks that compute on a device."""
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to test the program")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=0, help="number of threads; 0: the default of PyTorch")
    parser.add_argument("--json", type=Path, help="file for all metrics, rewritten after every row")


def add_repeats(parser: argparse.ArgumentParser) -> None:
    """Add the options for the number of rounds."""
    parser.add_argument(
        "--repeats", type=int, help="timed rounds, of which the median is reported (default: 10; 3 on a CPU)"
    )
    parser.add_argument("--warm-up", type=int, help="untimed rounds before them (default: 3; 1 on a CPU)")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of benchmarks that compare with the official code."""
    add_basics(parser)
    add_repeats(parser)
    switch = argparse.BooleanOptionalAction
    parser.add_argument("--official", type=Path, default=BESIDE, help="checkout (default: ../vjepa2)")
    parser.add_argument("--time", action=switch, default=True, help="measure time")
    parser.add_argument("--memory", action=switch, default=True, help="measure peak memory, in a separate pass")


def settle(options: argparse.Namespace, quick: Mapping[str, Any]) -> argparse.Namespace:
    """Give options the tiny sizes of --quick, and repeats as the device needs them where nothing is said."""
    if options.quick:
        vars(options).update(quick)
    if "repeats" in options:
        repeats, warm_up = _REPEATS[kind_of(options.device)]
        options.repeats = repeats if options.repeats is None else options.repeats
        options.warm_up = warm_up if options.warm_up is None else options.warm_up
    return options


def prepare(options: argparse.Namespace) -> None:
    """Set up PyTorch; to be called before anything is computed."""
    if options.threads:
        torch.set_num_threads(options.threads)
    if options.device != "cpu":
        use_expandable_segments()


def about(options: argparse.Namespace, given: list[str]) -> dict[str, Any]:
    """Return what holds for all rows of a benchmark."""
    cudnn = torch.backends.cudnn.version() if options.device != "cpu" else None
    return {"torch": torch.__version__, "cudnn": cudnn, "device": device_name(options.device), "arguments": given}


def introduction(options: argparse.Namespace) -> str:
    """Return what computes."""
    return f"torch {torch.__version__}, {device_name(options.device)}, {torch.get_num_threads()} threads"


@dataclass
class Turns:
    """What was seen of one way so far."""

    seconds: list[float] = field(default_factory=list)
    retries: int = 0  # times that the allocator gave memory back in turns that count
    failure: str | None = None

    @property
    def problem(self) -> str | None:
        """Why its time does not count, or None."""
        if self.failure or not self.retries:
            return self.failure
        return f"does not count: the allocator gave memory back {self.retries} times to go on"

    @property
    def median_s(self) -> float | None:
        """The median; None where it does not count, or there is nothing yet."""
        return statistics.median(self.seconds) if self.seconds and not self.problem else None

    @property
    def least_s(self) -> float | None:
        """The fastest; None as for the median."""
        return None if self.median_s is None else min(self.seconds)

    def figures(self) -> dict[str, Any]:
        """Return what a row holds of it."""
        return {
            "problem": self.problem, "s": self.median_s, "min_s": self.least_s, "repeats": len(self.seconds),
            "alloc_retries": self.retries,
        }  # fmt: skip


def rounds(
    steps: Mapping[str, Callable[[], object]], options: argparse.Namespace, after_failure: Callable[[], object]
) -> Iterator[dict[str, Turns]]:
    """Let all take turns, and yield what was seen so far after each round that counts: the same records, filled.

    Args:
        steps: What is timed, by the way's name.
        options: Of the command line.
        after_failure: Is called when one has failed, to let go of what it left.
    """
    seen = {way: Turns() for way in steps}
    for number in range(options.warm_up + options.repeats):
        for way, step in steps.items():
            if not seen[way].failure:
                _take_turn(step, seen[way], options.device, counts=number >= options.warm_up)
                if seen[way].failure:
                    after_failure()
        if number >= options.warm_up:
            yield seen


def timed(
    steps: Mapping[str, Callable[[], object]],
    options: argparse.Namespace,
    after_failure: Callable[[], object] = lambda: None,
) -> dict[str, Turns]:
    """Let all take turns, as `rounds` does, and return what was seen when all rounds were over."""
    *_, seen = rounds(steps, options, after_failure)
    return seen


def _take_turn(step: Callable[[], object], turns: Turns, device: str, *, counts: bool) -> None:
    before = alloc_retries(device)
    try:
        start = clock_s(device)
        step()
        seconds = clock_s(device) - start
    except Exception as error:
        turns.failure = problem_of(error)
        return
    if counts:
        turns.seconds.append(seconds)
        turns.retries += alloc_retries(device) - before


def ratio(base: Turns | None, own: Turns | None) -> float | None:
    """Return how much faster than a base: the median over neighbours in time; None where one of them does not count."""
    if base is None or own is None or base.median_s is None or own.median_s is None:
        return None
    return statistics.median(b / o for b, o in zip(base.seconds, own.seconds, strict=False))  # a round under way


class Profile(NamedTuple):
    """What the profiler saw of something done once."""

    events: Any  # one for each kind, with `key` and `count`
    waits: dict[str, int]  # of the host for the device, by what it calls

    def busy_ms(self) -> float:
        """Return how long the device's kernels ran in all; 0 on a CPU."""
        on_device = (event for event in self.events if event.device_type.name == "CUDA")
        return sum(event.self_device_time_total for event in on_device) / 1e3

    def dearest(self, device: str) -> list[dict[str, Any]]:
        """Return what took longest by itself, in milliseconds: of the device's kernels, or the CPU's operations."""
        order = self_time(device)
        events = sorted(self.events, key=lambda event: -getattr(event, order))[:PROFILED_ROWS]
        return [{"name": one.key, "ms": getattr(one, order) / 1e3, "count": one.count} for one in events]


def self_time(device: str) -> str:
    """Return what the profiler calls the time that counts on a device."""
    return "self_cpu_time_total" if device == "cpu" else "self_device_time_total"


def profiled(work: Callable[[], object], device: str) -> Profile:
    """Return what is done, and how often the host waits for the device in it.

    The profiler itself waits for the device when it ends: what it counts when nothing is done is taken off.
    """
    of_nothing = _profile_of_nothing(device)
    events = _profile(work, device)
    return Profile(events, waits(events, of_nothing, device))


def waits(events: Iterable[Any], of_nothing: Iterable[Any], device: str) -> dict[str, int]:
    """Return how often the host waits for the device, or asks it for a number, and by which call.

    Args:
        events: What the profiler saw.
        of_nothing: What it saw of doing nothing, which is its own.
        device: Where.
    """
    seen, own = (
        Counter({event.key: event.count for event in some if event.key in WAITS_ON[kind_of(device)]})
        for some in (events, of_nothing)
    )
    return dict(seen - own)


def _profile(work: Callable[[], object], device: str) -> Any:
    kinds = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if device != "cpu" else [])]
    with profile(activities=kinds, acc_events=True) as found:  # PyTorch 2.11 warns without it
        work()
    return found.key_averages()


@cache
def _profile_of_nothing(device: str) -> Any:
    _profile(_nothing, device)  # sets up what is set up once
    return _profile(_nothing, device)


def _nothing() -> None:
    pass


def clock_s(device: str) -> float:
    """Return seconds that a machine shared with others does not add to, as far as that can be."""
    if device == "cpu":
        return time.process_time() / torch.get_num_threads()
    torch.cuda.synchronize()
    return time.perf_counter()


def kind_of(device: str) -> str:
    """Return cuda for cuda:0, too."""
    return device.partition(":")[0]


def device_name(device: str) -> str:
    """Return what computes."""
    if device != "cpu":
        return torch.cuda.get_device_name()
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "CPU")
