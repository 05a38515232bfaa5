"""Console output of a closed-loop benchmark."""

from __future__ import annotations

from rich.table import Table

from vjepa2_ac.console.progress import MetricsTable, with_interval
from vjepa2_ac.simulation.closed_loop.benchmark import ClosedLoopBenchmark
from vjepa2_ac.simulation.closed_loop.tasks import ALSO, SUCCESS_M

_USUAL = {"planned", "nothing", "random", "scripted"}  # reasons of actions that are not mentioned


def benchmark_table(benchmark: ClosedLoopBenchmark) -> Table:
    """Return a table with a row for each policy; the intervals are 95 %, over episodes."""
    options = benchmark.options
    also = f", {ALSO[options.task]}," if ALSO[options.task] else ""
    criterion = f"within {100 * SUCCESS_M[options.task]:g} cm{also}"
    table = MetricsTable(
        f"{options.task} in domain {options.domain}: {options.episodes} problems of seed {options.seed},"
        f" {benchmark.results[0].steps} steps of {benchmark.seconds_per_step:.2f} s (95 % interval over episodes)",
        ["", f"{criterion} at the end", "once on the way", "left at the end, cm", "steps", "s per decision"],
    )
    for result in benchmark.results:
        table.add_row(
            result.policy,
            with_interval(result.success_rate, ".0%"),
            with_interval(result.success_ever_rate, ".0%"),
            with_interval(result.final_distance_cm, ".1f"),
            "" if result.steps_needed is None else f"{result.steps_needed.value:.1f}",
            f"{result.seconds_per_decision.value:.2f}",
        )
    return table


def benchmark_notes(benchmark: ClosedLoopBenchmark) -> tuple[str, ...]:
    """Return notes on unusual decisions and commands: a line each, none if all was as usual."""
    notes = []
    for result in benchmark.results:
        unusual = {why: number for why, number in result.why_counts.items() if why not in _USUAL}
        if unusual:
            counts = ", ".join(f"{why} {number}" for why, number in unusual.items())
            notes.append(f"{result.policy}: of {result.seconds.size} decisions {counts}")
        if result.unreachable.any():
            notes.append(f"{result.policy}: {result.unreachable.sum()} commands led out of the arm's reach")
    return tuple(notes)
