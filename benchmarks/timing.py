"""Time variants of one computation. The variants take turns, so that load on the machine slows all of them equally.

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
from memory import count_alloc_retries, use_expandable_segments
from rows import describe_failure
from torch.profiler import ProfilerActivity, profile

WAIT_EVENTS = {  # names of the profiler's events in which the host waits for the device
    "cuda": {"cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize"},
    "cpu": {"aten::_local_scalar_dense"},  # only to test the counting
}
PROFILED_ROWS = 15
DEFAULT_CHECKOUT = Path(__file__).resolve().parents[2] / "vjepa2"
_REPEATS = {"cuda": (10, 3), "cpu": (3, 1)}  # timed rounds and warm-up rounds, in which a GPU raises its clock


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
    parser.add_argument("--official", type=Path, default=DEFAULT_CHECKOUT, help="checkout (default: ../vjepa2)")
    parser.add_argument("--time", action=switch, default=True, help="measure time")
    parser.add_argument("--memory", action=switch, default=True, help="measure peak memory, in a separate pass")


def apply_defaults(options: argparse.Namespace, quick: Mapping[str, Any]) -> argparse.Namespace:
    """Apply the tiny sizes of --quick, and the defaults of --repeats and --warm-up for the device."""
    if options.quick:
        vars(options).update(quick)
    if "repeats" in options:
        repeats, warm_up = _REPEATS[device_kind(options.device)]
        options.repeats = repeats if options.repeats is None else options.repeats
        options.warm_up = warm_up if options.warm_up is None else options.warm_up
    return options


def set_up_torch(options: argparse.Namespace) -> None:
    """Set the number of threads and the allocator of PyTorch. Must be called before any computation."""
    if options.threads:
        torch.set_num_threads(options.threads)
    if options.device != "cpu":
        use_expandable_segments()


def describe_run(options: argparse.Namespace, arguments: list[str]) -> dict[str, Any]:
    """Return the versions, the device and the arguments, which are the same for all rows of a benchmark."""
    cudnn = torch.backends.cudnn.version() if options.device != "cpu" else None
    device = get_device_name(options.device)
    return {"torch": torch.__version__, "cudnn": cudnn, "device": device, "arguments": arguments}


def describe_machine(options: argparse.Namespace) -> str:
    """Return the PyTorch version, the device and the number of threads as text."""
    return f"torch {torch.__version__}, {get_device_name(options.device)}, {torch.get_num_threads()} threads"


@dataclass
class Timings:
    """The timings of one variant in the rounds so far."""

    seconds: list[float] = field(default_factory=list)
    retries: int = 0  # number of times that the allocator had to release memory in timed rounds
    failure: str | None = None

    @property
    def problem(self) -> str | None:
        """The reason why the timings are invalid; None if they are valid."""
        if self.failure or not self.retries:
            return self.failure
        return f"invalid: the allocator had to release memory {self.retries} times"

    @property
    def median_s(self) -> float | None:
        """The median; None if the timings are invalid, or before the first timed round."""
        return statistics.median(self.seconds) if self.seconds and not self.problem else None

    @property
    def min_s(self) -> float | None:
        """The shortest time; None as for the median."""
        return None if self.median_s is None else min(self.seconds)

    def metrics(self) -> dict[str, Any]:
        """Return the fields of a row."""
        return {
            "problem": self.problem, "s": self.median_s, "min_s": self.min_s, "repeats": len(self.seconds),
            "alloc_retries": self.retries,
        }  # fmt: skip


def time_rounds(
    steps: Mapping[str, Callable[[], object]], options: argparse.Namespace, after_failure: Callable[[], object]
) -> Iterator[dict[str, Timings]]:
    """Run all variants in turn, and yield the timings after each timed round. The yielded records are updated in place.

    Args:
        steps: The computation of each variant, by the variant's name.
        options: The options of the command line.
        after_failure: Called after a variant has failed, to release its memory.
    """
    timings = {variant: Timings() for variant in steps}
    for number in range(options.warm_up + options.repeats):
        for variant, step in steps.items():
            if not timings[variant].failure:
                _time_once(step, timings[variant], options.device, is_timed=number >= options.warm_up)
                if timings[variant].failure:
                    after_failure()
        if number >= options.warm_up:
            yield timings


def time_variants(
    steps: Mapping[str, Callable[[], object]],
    options: argparse.Namespace,
    after_failure: Callable[[], object] = lambda: None,
) -> dict[str, Timings]:
    """Run all variants in turn, as `time_rounds` does, and return the timings after the last round."""
    *_, timings = time_rounds(steps, options, after_failure)
    return timings


def _time_once(step: Callable[[], object], timings: Timings, device: str, *, is_timed: bool) -> None:
    before = count_alloc_retries(device)
    try:
        start = read_clock_s(device)
        step()
        seconds = read_clock_s(device) - start
    except Exception as error:
        timings.failure = describe_failure(error)
        return
    if is_timed:
        timings.seconds.append(seconds)
        timings.retries += count_alloc_retries(device) - before


def compute_speed_up(base: Timings | None, timings: Timings | None) -> float | None:
    """Return the speed relative to a baseline: the median of the rounds' ratios; None if any timings are invalid."""
    if base is None or timings is None or base.median_s is None or timings.median_s is None:
        return None
    pairs = zip(base.seconds, timings.seconds, strict=False)  # during a round the baseline has one timing more
    return statistics.median(base_s / seconds for base_s, seconds in pairs)


class Profile(NamedTuple):
    """The profile of a computation that ran once."""

    events: Any  # one event for each operation, with `key` and `count`
    waits: dict[str, int]  # how often the host waits for the device, by the name of the event

    def busy_ms(self) -> float:
        """Return the total duration of the device's kernels in milliseconds; 0 on a CPU."""
        on_device = (event for event in self.events if event.device_type.name == "CUDA")
        return sum(event.self_device_time_total for event in on_device) / 1e3

    def slowest(self, device: str) -> list[dict[str, Any]]:
        """Return the slowest kernels of the device, or operations of the CPU, with their own time in milliseconds."""
        key = self_time_key(device)
        events = sorted(self.events, key=lambda event: -getattr(event, key))[:PROFILED_ROWS]
        return [{"name": event.key, "ms": getattr(event, key) / 1e3, "count": event.count} for event in events]


def self_time_key(device: str) -> str:
    """Return the profiler's name for the time of an event without the events that it calls."""
    return "self_cpu_time_total" if device == "cpu" else "self_device_time_total"


def profile_step(work: Callable[[], object], device: str) -> Profile:
    """Run a computation once, and return its profile.

    The profiler itself waits for the device when it exits. These waits are measured without work, and subtracted.
    """
    empty_events = _profile_empty_step(device)
    events = _profile(work, device)
    return Profile(events, count_waits(events, empty_events, device))


def count_waits(events: Iterable[Any], empty_events: Iterable[Any], device: str) -> dict[str, int]:
    """Return how often the host waits for the device, or reads a number from it, by the name of the event.

    Args:
        events: The profiler's events.
        empty_events: The profiler's events without any work.
        device: The device, such as cuda.
    """
    waits, profiler_waits = (
        Counter({event.key: event.count for event in some_events if event.key in WAIT_EVENTS[device_kind(device)]})
        for some_events in (events, empty_events)
    )
    return dict(waits - profiler_waits)


def _profile(work: Callable[[], object], device: str) -> Any:
    kinds = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if device != "cpu" else [])]
    with profile(activities=kinds, acc_events=True) as profiler:  # PyTorch 2.11 warns without acc_events
        work()
    return profiler.key_averages()


@cache
def _profile_empty_step(device: str) -> Any:
    _profile(lambda: None, device)  # the first use initialises the profiler
    return _profile(lambda: None, device)


def read_clock_s(device: str) -> float:
    """Return a time in seconds that other programs on the machine affect as little as possible."""
    if device == "cpu":
        return time.process_time() / torch.get_num_threads()
    torch.cuda.synchronize()
    return time.perf_counter()


def device_kind(device: str) -> str:
    """Return a device without its index: cuda for cuda:0."""
    return device.partition(":")[0]


def get_device_name(device: str) -> str:
    """Return the name of the GPU or the CPU."""
    if device != "cpu":
        return torch.cuda.get_device_name()
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "CPU")
