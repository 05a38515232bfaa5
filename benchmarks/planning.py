"""Measure time and utilisation of a decision: this package, an unoptimised variant, and the official notebook.

    python benchmarks/planning.py --threads 1 --horizon 1 2 4 --dtype float32
    python benchmarks/planning.py --official ../vjepa2 --threads 1
    python benchmarks/planning.py --device cuda --at-once 32 64 128 --official ../vjepa2   # the paper's setting

A decision is a complete search by the cross-entropy method, from latents to actions, without the encoding of the image.
On CUDA the default is the paper's setting: 800 samples x 10 iterations, horizon 1 and 2, all 24 layers, bfloat16.

plain      the same planner without optimisations: all steps are computed again for each step, poses one by one by SciPy
official   the planner and the predictor of the official notebook (`official_planner.py`); needs a checkout of
           facebookresearch/vjepa2 at --official
ours/N     this package with N samples per call of the predictor; plain uses the first N. N+compiled: with compiled
           blocks (`planning.compile`), if --compile is set. N+adapter: the first N with a float32 LoRA, prepared as in
           `plan RUN`, unless --no-adapter is set

A variant is compared only if it selects the same actions with the same energies in float32, with the same weights and
seed. A ratio above 1 means faster than plain or official. The variants take turns. On a CPU the process time divided by
the number of threads is measured, otherwise wall time; the table shows the median and the shortest time. `MFU` is the
number of model FLOPs (FLOPs of `training.flops`, the same for all variants), divided by the FLOPs that the device
computes in the same time in a matrix product. `retries` counts how often the allocator had to release memory while a
variant was timed; its time is then invalid. The peak memory of two decisions, including the weights, is measured after
all times: each line alone on the device, or in a new process on a CPU.

--json is written after every round. A variant that runs out of memory or fails is reported, and the others continue.
After any other failure than a lack of memory the exit status is 1.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from decision_variants import OFFICIAL, PLAIN, Variant
from memory import is_expandable, measure_peak_alone, measure_peak_gb, release_memory
from official_planner import PLANNER
from planning_variants import Bench
from rows import Row, Rows, format_cell
from timing import (
    PROFILED_ROWS,
    Timings,
    add_options,
    apply_defaults,
    compute_speed_up,
    describe_machine,
    describe_run,
    profile_step,
    self_time_key,
    set_up_torch,
    time_rounds,
)

from vjepa2_ac.distributed import measure_matmul_speed

QUICK = {
    "layers": 1, "width": 128, "latent_dim": 128, "image_size": 32, "samples": 6, "iterations": 2, "at_once": [4, 2],
    "horizon": [2], "repeats": 1, "warm_up": 0, "threads": 1,
}  # fmt: skip
_ON_CPU = {"layers": 2, "samples": 8, "iterations": 2, "horizon": [2, 4], "at_once": [8], "dtype": ["float32"]}
_ON_CUDA = {"layers": 24, "samples": 800, "iterations": 10, "horizon": [1, 2], "at_once": [64], "dtype": ["bfloat16"]}
_NAMES = f"{'horizon':>7}  {'variant':22}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each horizon and variant: times, MFU, ratios to plain and official, peak memory."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(arguments)
    set_up_torch(options)
    if options.memory_of:
        variant = Variant(options.memory_of[0], int(options.memory_of[1]))
        print(json.dumps(measure_variant_memory(options, options.dtype[0], options.horizon[0], variant)))
        return
    _introduce(options)
    rows = Rows(options.json, **describe_run(options, arguments))
    for dtype in options.dtype:
        rows.attempt(partial(measure, options, arguments, dtype, rows), dtype=dtype)
    rows.finish()


def measure(options: argparse.Namespace, arguments: list[str], dtype: str, rows: Rows) -> None:
    """Measure all horizons in one precision: first the times, then the memory."""
    variants = measure_time(options, dtype, rows)
    release_memory(options.device)
    if options.memory:
        print(f"{dtype}, memory\n{_NAMES}{'peak GB':>12}")
        for horizon, variants_of_horizon in variants.items():
            for variant in variants_of_horizon:
                row = measure_memory_row(options, arguments, dtype, horizon, variant)
                rows.add(row)
                print(format_memory_line(row), flush=True)


def measure_time(options: argparse.Namespace, dtype: str, rows: Rows) -> dict[int, list[Variant]]:
    """Time all horizons, if --time is set, and return the compared variants of each horizon."""
    bench = Bench(options, dtype)
    rows.about["expandable_segments"] = is_expandable(options.device)
    # The comparison is in float32, before the first decision casts the weights.
    variants = {horizon: select_matching_variants(bench, horizon, rows) for horizon in options.horizon}
    if options.time:
        ceiling = measure_matmul_speed(bench.device, bench.dtype)
        print(f"{dtype}: ceiling {ceiling / 1e12:.3g} TFLOP/s")
        titles = ("s/decision", "min", "samples/s", "MFU", "retries", "of plain", "of official")
        print(_NAMES + "".join(f"{title:>12}" for title in titles))
        for horizon, variants_of_horizon in variants.items():
            work = partial(time_horizon, bench, horizon, variants_of_horizon, ceiling, rows)
            rows.attempt(work, dtype=dtype, horizon=horizon)
    return variants


def time_horizon(bench: Bench, horizon: int, variants: Sequence[Variant], ceiling: float, rows: Rows) -> None:
    """Add a row for each variant, and with --profile a profile of the last variant."""
    device = bench.options.device
    release_memory(device)
    timings: dict[str, Timings] = {}  # empty until the first timed round is finished

    def make_rows() -> list[Row]:
        return [make_time_row(bench, horizon, variant, timings, ceiling) for variant in variants]

    decisions = {variant.name: bench.make_decision(variant, horizon) for variant in variants}
    for timings_so_far in time_rounds(decisions, bench.options, partial(release_memory, device)):
        timings.update(timings_so_far)
        rows.write_unfinished(*make_rows())
    for row in make_rows():
        rows.add(row)
        print(format_time_line(row), flush=True)
    if bench.options.profile:
        about = {"measured": "profile", "horizon": horizon, "variant": variants[-1].name}
        rows.attempt(partial(profile_decision, decisions[variants[-1].name], bench, rows, about), **about)


def make_time_row(
    bench: Bench, horizon: int, variant: Variant, all_timings: Mapping[str, Timings], ceiling: float
) -> Row:
    """Return the row of a variant after the rounds so far. `all_timings` are those of all variants, by name."""
    timings = all_timings.get(variant.name)
    metrics = (timings or Timings()).metrics()
    seconds = metrics["s"]
    return {
        "measured": "time", "dtype": str(bench.dtype).removeprefix("torch."), "ceiling": ceiling, "horizon": horizon,
        "variant": variant.name, "at_once": variant.at_once, **metrics,
        "samples_per_s": seconds and bench.sequences / seconds,
        "mfu": seconds and bench.flops(horizon) / seconds / ceiling,
        **{f"ratio_to_{base}": compute_speed_up(all_timings.get(base), timings) for base in (PLAIN, OFFICIAL)},
    }  # fmt: skip


def format_time_line(row: Row) -> str:
    """Return a line of the table of times."""
    if row["problem"]:
        return f"{format_names(row)}{row['problem']}"
    text = f"{format_names(row)}{row['s']:12.3f}{row['min_s']:12.3f}{row['samples_per_s']:12.2f}{row['mfu']:12.1%}"
    ratios = "".join(format_cell(row[f"ratio_to_{base}"], 12, ".2f") for base in (PLAIN, OFFICIAL))
    return f"{text}{row['alloc_retries']:12}{ratios}"


def profile_decision(decide: Callable[[], object], bench: Bench, rows: Rows, about: Row) -> None:
    """Add and print the profile of a decision, and on CUDA how often the host waits for the device."""
    device = bench.options.device
    profile = profile_step(decide, device)
    rows.add({**about, "waits": profile.waits, "slowest": profile.slowest(device)})
    print(profile.events.table(sort_by=self_time_key(device), row_limit=PROFILED_ROWS, max_name_column_width=40))
    if device != "cpu":
        print(f"host synchronisations in {bench.options.iterations} iterations: {profile.waits}")


def measure_memory_row(
    options: argparse.Namespace, arguments: list[str], dtype: str, horizon: int, variant: Variant
) -> Row:
    """Return a row with the peak memory of a variant."""
    own_arguments = ["--horizon", str(horizon), "--dtype", dtype, "--memory-of", variant.name, str(variant.at_once)]
    measure = partial(measure_variant_memory, options, dtype, horizon, variant)
    return {
        "measured": "memory", "dtype": dtype, "horizon": horizon, "variant": variant.name,
        **measure_peak_alone(measure, [__file__, *arguments, *own_arguments], options.device),
    }  # fmt: skip


def measure_variant_memory(options: argparse.Namespace, dtype: str, horizon: int, variant: Variant) -> float:
    """Return the peak memory of two decisions of one variant in 10^9 bytes, without the other variants in memory."""
    bench = Bench(options, dtype)
    decide = bench.make_decision(variant, horizon)
    bench.keep_only(variant)
    return measure_peak_gb(decide, options.device)


def format_memory_line(row: Row) -> str:
    """Return a line of the table of memory."""
    return format_names(row) + (row["problem"] or f"{row['peak_gb']:12.2f}")


def format_names(row: Row) -> str:
    """Return the first columns of a line: the horizon and the variant."""
    return f"{row['horizon']:7}  {row['variant']:22}"


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
    return apply_defaults(options, QUICK)


def select_matching_variants(bench: Bench, horizon: int, rows: Rows) -> list[Variant]:
    """Return the variants that select the same actions as this package, which are compared."""
    matching = []
    for variant in list_variants(bench):
        about = {"measured": "same actions", "horizon": horizon, "variant": variant.name}
        if rows.attempt(partial(selects_same_actions, bench, variant, horizon, rows, about), **about):
            matching.append(variant)
    return matching


def selects_same_actions(bench: Bench, variant: Variant, horizon: int, rows: Rows, about: Row) -> bool:
    """Return whether a variant selects the same actions as this package, and print the result."""
    difference = bench.difference(variant, horizon)
    rows.add({**about, "difference": str(difference), "is_rounding": difference.is_rounding})
    consequence = "" if difference.is_rounding else ". No ratio is reported, because the actions differ"
    print(f"horizon {horizon}, {variant.name}: {difference} (float32){consequence}")
    return difference.is_rounding


def list_variants(bench: Bench) -> list[Variant]:
    """Return all requested variants."""
    options = bench.options
    kinds = (False, True) if options.compile else (False,)
    ours = [Variant.ours(count, compiled=compiled) for count in options.at_once for compiled in kinds]
    adapted = [Variant.ours(options.at_once[0], compiled=compiled, adapter=True) for compiled in kinds]
    official = [Variant(OFFICIAL, options.samples)] if bench.has_official else []
    if not official:
        print(f"official: skipped, needs {options.official / PLANNER}, found no such file")
    return [Variant(PLAIN, options.at_once[0]), *official, *ours, *(adapted if options.adapter else ())]


def _introduce(options: argparse.Namespace) -> None:
    load = ", ".join(f"{average:.1f}" for average in os.getloadavg())
    print(
        f"{describe_machine(options)}, load {load};"
        f" {options.layers} layers of width {options.width}, {options.image_size} px, {options.samples} samples x"
        f" {options.iterations} iterations, {options.repeats} repeats after {options.warm_up}"
    )


if __name__ == "__main__":
    main()
