"""Measure time and utilisation of a decision: this package, an unoptimised variant, and the official notebook.

    python benchmarks/planning.py --threads 1 --horizon 1 2 4 --dtype float32
    python benchmarks/planning.py --official ../vjepa2 --threads 1
    python benchmarks/planning.py --device cuda --at-once 32 64 128 --official ../vjepa2   # the paper's setting

A decision is a whole search by the cross-entropy method, from latents to actions; encoding the picture is not part of
it. On CUDA the default is the paper's: 800 samples x 10 iterations, horizon 1 and 2, all 24 layers, bfloat16.

plain      the same planner with everything computed again for each step, and poses by SciPy, one after the other
official   the planner of the official notebook on the official predictor, where a checkout of facebookresearch/vjepa2
           is at --official (`official_planner.py`)
ours/N     ours, N samples through the predictor at once; plain takes as many as the first of these. With --compile
           once more with compiled blocks (`planning.compile`): N+compiled. The first N once
           more with a float32 LoRA on, made ready as `plan RUN` does it: N+adapter (--no-adapter: not)

Before anything is timed all must choose the same actions, on the same weights with the same seed,
in float32: what chooses others, or finds other energies, gets no ratio. A ratio over 1 means faster than plain, or than
the official one. All take turns; on a CPU the process's own time over its threads counts, else wall time; the median,
and the fastest. MFU: the model FLOPs of `training.flops` over what the device does in a product of matrices,
measured first; the same for every way. `retries`: how often the allocator had to give memory back while a way was
timed, whose time then does not count. Peak memory, weights included, is of two decisions in a pass of its own, after
all times: each line alone on the device, or on a CPU in a process of its own.

--json is written after every round. What runs out of memory says so; what fails otherwise, too, and the exit status is
1 then, when all else was measured.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from decision_ways import OFFICIAL, PLAIN, Way
from memory import is_expandable, let_go, peak_alone, peak_gb
from official_planner import PLANNER
from planning_variants import Bench
from rows import Row, Rows, cell
from timing import (
    PROFILED_ROWS,
    Turns,
    about,
    add_options,
    introduction,
    prepare,
    profiled,
    ratio,
    rounds,
    self_time,
    settle,
)

from vjepa2_ac.distributed import measure_matmul_speed

QUICK = {
    "layers": 1, "width": 128, "latent_dim": 128, "image_size": 32, "samples": 6, "iterations": 2, "at_once": [4, 2],
    "horizon": [2], "repeats": 1, "warm_up": 0, "threads": 1,
}  # fmt: skip
_ON_CPU = {"layers": 2, "samples": 8, "iterations": 2, "horizon": [2, 4], "at_once": [8], "dtype": ["float32"]}
_ON_CUDA = {"layers": 24, "samples": 800, "iterations": 10, "horizon": [1, 2], "at_once": [64], "dtype": ["bfloat16"]}
_NAMES = f"{'horizon':>7}  {'way':22}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each horizon and way: seconds a decision, MFU, ratios to plain and official; peak memory."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(given)
    prepare(options)
    if options.memory_of:
        way = Way(options.memory_of[0], int(options.memory_of[1]))
        print(json.dumps(memory_of_way(options, options.dtype[0], options.horizon[0], way)))
        return
    _introduce(options)
    rows = Rows(options.json, **about(options, given))
    for dtype in options.dtype:
        rows.attempt(partial(measure, options, given, dtype, rows), dtype=dtype)
    rows.finish()


def measure(options: argparse.Namespace, given: list[str], dtype: str, rows: Rows) -> None:
    """Measure all horizons in one precision: first time, then memory."""
    ways = measure_time(options, dtype, rows)
    let_go(options.device)
    if options.memory:
        print(f"{dtype}, memory\n{_NAMES}{'peak GB':>12}")
        for horizon, same in ways.items():
            for way in same:
                row = memory_row(options, given, dtype, horizon, way)
                rows.add(row)
                print(memory_line(row), flush=True)


def measure_time(options: argparse.Namespace, dtype: str, rows: Rows) -> dict[int, list[Way]]:
    """Time all horizons, if that is asked for, and return the ways of each; nothing stays on the device."""
    bench = Bench(options, dtype)
    rows.about["expandable_segments"] = is_expandable(options.device)
    ways = {horizon: same_ways(bench, horizon, rows) for horizon in options.horizon}  # before ours takes its own type
    if options.time:
        ceiling = measure_matmul_speed(bench.device, bench.dtype)
        print(f"{dtype}: ceiling {ceiling / 1e12:.3g} TFLOP/s")
        titles = ("s/decision", "min", "samples/s", "MFU", "retries", "of plain", "of official")
        print(_NAMES + "".join(f"{title:>12}" for title in titles))
        for horizon, same in ways.items():
            named = {"dtype": dtype, "horizon": horizon}
            rows.attempt(partial(time_horizon, bench, horizon, same, ceiling, rows), **named)
    return ways


def time_horizon(bench: Bench, horizon: int, same: Sequence[Way], ceiling: float, rows: Rows) -> None:
    """Add a row for each way, and if that is asked for one of where the time goes in the last one."""
    device = bench.options.device
    let_go(device)
    seen: dict[str, Turns] = {}  # nothing before the first round is over

    def rows_so_far() -> list[Row]:
        return [time_row(bench, horizon, way, seen, ceiling) for way in same]

    decisions = {way.name: bench.decision(way, horizon) for way in same}
    for so_far in rounds(decisions, bench.options, partial(let_go, device)):
        seen = so_far
        rows.so_far(*rows_so_far())
    for row in rows_so_far():
        rows.add(row)
        print(time_line(row), flush=True)
    if bench.options.profile:
        named = {"measured": "profile", "horizon": horizon, "way": same[-1].name}
        rows.attempt(partial(profile_decision, decisions[same[-1].name], bench, rows, named), **named)


def time_row(bench: Bench, horizon: int, way: Way, seen: Mapping[str, Turns], ceiling: float) -> Row:
    """Return what was seen of a way so far."""
    turns = seen.get(way.name)
    figures = (turns or Turns()).figures()
    seconds = figures["s"]
    return {
        "measured": "time", "dtype": str(bench.dtype).removeprefix("torch."), "ceiling": ceiling, "horizon": horizon,
        "way": way.name, "at_once": way.at_once, **figures, "samples_per_s": seconds and bench.sequences / seconds,
        "mfu": seconds and bench.flops(horizon) / seconds / ceiling,
        **{f"ratio_to_{base}": ratio(seen.get(base), turns) for base in (PLAIN, OFFICIAL)},
    }  # fmt: skip


def time_line(row: Row) -> str:
    """Return a row of the table of times."""
    if row["problem"]:
        return f"{names_of(row)}{row['problem']}"
    text = f"{names_of(row)}{row['s']:12.3f}{row['min_s']:12.3f}{row['samples_per_s']:12.2f}{row['mfu']:12.1%}"
    ratios = "".join(cell(row[f"ratio_to_{base}"], 12, ".2f") for base in (PLAIN, OFFICIAL))
    return f"{text}{row['alloc_retries']:12}{ratios}"


def profile_decision(decide: Callable[[], object], bench: Bench, rows: Rows, named: Row) -> None:
    """Add and print where the time of a decision goes, and on CUDA how often the host waits for the device in it."""
    device = bench.options.device
    found = profiled(decide, device)
    rows.add({**named, "waits": found.waits, "dearest": found.dearest(device)})
    print(found.events.table(sort_by=self_time(device), row_limit=PROFILED_ROWS, max_name_column_width=40))
    if device != "cpu":
        print(f"host synchronisations in {bench.options.iterations} iterations: {found.waits}")


def memory_row(options: argparse.Namespace, given: list[str], dtype: str, horizon: int, way: Way) -> Row:
    """Return the peak of a way."""
    own = ["--horizon", str(horizon), "--dtype", dtype, "--memory-of", way.name, str(way.at_once)]
    alone = partial(memory_of_way, options, dtype, horizon, way)
    return {
        "measured": "memory", "dtype": dtype, "horizon": horizon, "way": way.name,
        **peak_alone(alone, [__file__, *given, *own], options.device),
    }  # fmt: skip


def memory_of_way(options: argparse.Namespace, dtype: str, horizon: int, way: Way) -> float:
    """Return the peak in 10^9 bytes of two decisions of one way, with nothing of the others in memory."""
    bench = Bench(options, dtype)
    decide = bench.decision(way, horizon)
    bench.keep_only(way)
    return peak_gb(decide, options.device)


def memory_line(row: Row) -> str:
    """Return a row of the table of memory."""
    return names_of(row) + (row["problem"] or f"{row['peak_gb']:12.2f}")


def names_of(row: Row) -> str:
    """Return the beginning of a row of a table: what horizon, and which way."""
    return f"{row['horizon']:7}  {row['way']:22}"


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layers", type=int, help="layers of the predictor (default: 24; 2 on a CPU)")
    parser.add_argument("--width", type=int, default=1024, help="width of the predictor, a multiple of 64")
    parser.add_argument("--latent-dim", type=int, default=1408, help="width of a latent, a multiple of 64")
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument("--samples", type=int, help="samples per iteration (default: 800; 8 on a CPU)")
    parser.add_argument("--iterations", type=int, help="iterations per decision (default: 10; 2 on a CPU)")
    parser.add_argument("--horizon", type=int, nargs="+", help="model steps of a plan (default: 1 2; 2 4 on a CPU)")
    parser.add_argument(
        "--at-once", type=int, nargs="+", help="batch sizes of samples, one row each (default: 64; 8 on a CPU)"
    )
    parser.add_argument("--dtype", nargs="+", choices=("float32", "bfloat16"), help="default: bfloat16; CPU: float32")
    add_options(parser)
    parser.add_argument("--compile", action="store_true", help="also measure this package with compiled blocks")
    parser.add_argument(
        "--adapter",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="also measure this package with an adapter",
    )
    parser.add_argument(
        "--profile",
        action="store_true",
        help="print a profile of this package, and on CUDA the number of host synchronisations",
    )
    parser.add_argument("--memory-of", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    defaults = _ON_CPU if options.device == "cpu" else _ON_CUDA
    vars(options).update({name: value for name, value in defaults.items() if getattr(options, name) is None})
    return settle(options, QUICK)


def same_ways(bench: Bench, horizon: int, rows: Rows) -> list[Way]:
    """Return the ways to compare: those that choose the same actions."""
    same = []
    for way in candidates(bench):
        named = {"measured": "same actions", "horizon": horizon, "way": way.name}
        if rows.attempt(partial(chooses_the_same, bench, way, horizon, rows, named), **named):
            same.append(way)
    return same


def chooses_the_same(bench: Bench, way: Way, horizon: int, rows: Rows, named: Row) -> bool:
    """Return whether a variant chooses the same actions as this package, and print the result."""
    found = bench.difference(way, horizon)
    rows.add({**named, "difference": str(found), "is_none": found.is_none})
    told = "" if found.is_none else ". No ratio is reported, because the actions differ"
    print(f"horizon {horizon}, {way.name}: {found} (float32){told}")
    return found.is_none


def candidates(bench: Bench) -> list[Way]:
    """Return all requested variants."""
    options = bench.options
    kinds = (False, True) if options.compile else (False,)
    ours = [Way.ours(count, compiled=compiled) for count in options.at_once for compiled in kinds]
    adapted = [Way.ours(options.at_once[0], compiled=compiled, adapter=True) for compiled in kinds]
    official = [Way(OFFICIAL, options.samples)] if bench.has_official else []
    if not official:
        print(f"official: skipped, needs {options.official / PLANNER}, found no such file")
    return [Way(PLAIN, options.at_once[0]), *official, *ours, *(adapted if options.adapter else ())]


def _introduce(options: argparse.Namespace) -> None:
    load = ", ".join(f"{one:.1f}" for one in os.getloadavg())
    print(
        f"{introduction(options)}, load {load};"
        f" {options.layers} layers of width {options.width}, {options.image_size} px, {options.samples} samples x"
        f" {options.iterations} iterations, {options.repeats} repeats after {options.warm_up}"
    )


if __name__ == "__main__":
    main()
