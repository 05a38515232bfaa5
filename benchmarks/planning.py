"""How long does a decision take, and what share of the machine does it use? Ours, plain, and the official notebook's.

    python benchmarks/planning.py --threads 1 --horizon 1 2 4 --dtype float32
    python benchmarks/planning.py --official ../vjepa2 --threads 1
    python benchmarks/planning.py --device cuda --at-once 32 64 128 --official ../vjepa2   # the paper's setting

A decision is a whole search by the cross-entropy method, from latents to actions; encoding the picture is not part of
it. On CUDA the default is the paper's: 800 samples x 10 iterations, horizon 1 and 2, all 24 layers, bfloat16.

plain      the same planner with everything computed again for each step, and poses by SciPy, one after the other
official   the planner of the official notebook on the official predictor, where a checkout of facebookresearch/vjepa2
           is at --official (`official_planner.py`)
ours/N     ours, N samples through the predictor at once; plain takes as many as the first of these. With --compile
           once more with compiled blocks (`planning.compile`): N+compiled. With --quantize once more in 8 bits
           (`planning.quantize`): N+fp8, and by how much the energy of its plan changes

Before anything is timed all must choose the same actions, on the same weights with the same seed, in float32: what
chooses others, or finds other energies, gets no ratio. A ratio over 1 means faster than plain, or than the official
one. All take turns; on a CPU the process's own time over its threads counts, else wall time. MFU: the model FLOPs of
`training.cost.flops` over what the device does in a product of matrices, measured first; the same for every way. Peak
memory, weights included, is of two decisions in a process of its own for each line.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import sys
from collections.abc import Callable, Sequence

import torch
from official_planner import PLANNER
from timed_decisions import OFFICIAL, PLAIN, Bench, Way
from timing import WAITS, add_options, device_name, in_own_process, peak_memory_gb, take_turns
from torch.profiler import ProfilerActivity, profile

from vjepa2_ac.training.health import matmul_speed

QUICK = {
    "layers": 1, "width": 128, "latent_dim": 128, "image_size": 32, "samples": 6, "iterations": 2, "at_once": [4, 1],
    "horizon": [3], "repeats": 1, "threads": 1,
}  # fmt: skip
_ON_CPU = {"layers": 2, "samples": 8, "iterations": 2, "horizon": [2, 4], "at_once": [8], "dtype": ["float32"]}
_ON_CUDA = {"layers": 24, "samples": 800, "iterations": 10, "horizon": [1, 2], "at_once": [64], "dtype": ["bfloat16"]}
_PROFILED_ROWS = 15


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each horizon and way: seconds a decision, MFU, peak memory, ratios to plain and official."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(given)
    if options.memory_of:
        print(json.dumps(memory_of_way(Bench(options, options.dtype[0]), options)))
        return
    _introduce(options)
    for dtype in options.dtype:
        bench = Bench(options, dtype)
        ways = {horizon: same_ways(bench, horizon) for horizon in options.horizon}  # before ours takes its own type
        ceiling = matmul_speed(bench.device, bench.dtype)
        print(f"{dtype}: ceiling {ceiling / 1e12:.3g} TFLOP/s")
        titles = ("s/decision", "samples/s", "MFU", "peak GB", "of plain", "of official")
        print(f"{'horizon':>7}  {'way':19}" + "".join(f"{title:>12}" for title in titles))
        for horizon, same in ways.items():
            seconds = take_turns({way.name: bench.decision(way, horizon) for way in same}, options)
            for way in same:
                if way.settings["quantize"] != "off":
                    added = f"{bench.added_energy(way, horizon):+.2%}, as the plain model sees it"
                    print(f"{horizon:7}  {way.name}: the plan's energy changes by {added}")
            for way in same:
                median = statistics.median(seconds[way.name])
                peak = memory_in_own_process(given, way, horizon, dtype) if options.memory else math.nan
                print(
                    f"{horizon:7}  {way.name:19}{median:12.3f}{bench.sequences / median:12.2f}"
                    f"{bench.flops(horizon) / median / ceiling:12.1%}{peak:12.2f}"
                    + "".join(f"{ratio(seconds, base, way.name):12.2f}" for base in (PLAIN, OFFICIAL)),
                    flush=True,
                )
            if options.profile:
                print(profiled(bench.decision(same[-1], horizon), options))


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layers", type=int, help="of the predictor (default: 24; 2 on a CPU)")
    parser.add_argument("--width", type=int, default=1024, help="of the predictor, 64 a head")
    parser.add_argument("--latent-dim", type=int, default=1408, help="width of a latent, a multiple of 64")
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument("--samples", type=int, help="of an iteration (default: 800; 8 on a CPU)")
    parser.add_argument("--iterations", type=int, help="of a decision (default: 10; 2 on a CPU)")
    parser.add_argument("--horizon", type=int, nargs="+", help="model steps of a plan (default: 1 2; 2 4 on a CPU)")
    parser.add_argument("--at-once", type=int, nargs="+", help="samples at once: a line each (default: 64; 8 on a CPU)")
    parser.add_argument("--dtype", nargs="+", choices=("float32", "bfloat16"), help="default: bfloat16; CPU: float32")
    add_options(parser)
    parser.add_argument("--quantize", nargs="+", choices=("int8", "fp8"), default=[], help="ours once more in 8 bits")
    parser.add_argument("--compile", action="store_true", help="ours once more with compiled blocks")
    parser.add_argument(
        "--profile", action="store_true", help="say where the time of ours goes, and on CUDA how often the host waits"
    )
    parser.add_argument("--memory-of", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    defaults = _ON_CPU if options.device == "cpu" else _ON_CUDA
    vars(options).update({name: value for name, value in defaults.items() if getattr(options, name) is None})
    if options.quick:
        vars(options).update(QUICK)
    if options.threads:
        torch.set_num_threads(options.threads)
    return options


def same_ways(bench: Bench, horizon: int) -> list[Way]:
    """Return the ways to compare: those that choose the same actions."""
    ours = [
        Way.ours(count, compiled=compiled, quantize=quantize)
        for count in bench.options.at_once
        for quantize in ("off", *bench.options.quantize)
        for compiled in ((False, True) if bench.options.compile else (False,))
    ]
    candidates = [Way(PLAIN, ours[0].at_once)]
    if bench.has_official:
        candidates.append(Way(OFFICIAL, bench.options.samples))
    else:
        print(f"official: skipped, for there is no {bench.options.official / PLANNER}")
    same = []
    for way, found in bench.differences([*candidates, *ours], horizon).items():
        in_8_bits = way.settings["quantize"] != "off"  # which chooses others, and is to say how much worse they are
        told = "" if found.is_none or in_8_bits else ": NO RATIO, for it chooses others"
        print(f"horizon {horizon}, {way.name}: {found} (float32){told}")
        same += [way] if found.is_none or in_8_bits else []
    return same


def ratio(seconds: dict[str, list[float]], base: str, way: str) -> float:
    """Return how much faster than a base: the median over neighbours in time; not a number where there is no base."""
    if base not in seconds:
        return math.nan
    return statistics.median(b / o for b, o in zip(seconds[base], seconds[way], strict=True))


def profiled(decide: Callable[[], object], options: argparse.Namespace) -> str:
    """Return where the time of a decision goes, and how often the host waits for the device in it."""
    on_cuda = options.device != "cpu"
    with profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_cuda else [])]) as found:
        decide()
    table = found.key_averages()
    waits = {one.key: one.count for one in table if one.key in WAITS}
    order = "self_device_time_total" if on_cuda else "self_cpu_time_total"
    rows = table.table(sort_by=order, row_limit=_PROFILED_ROWS, max_name_column_width=40)
    return f"{rows}the host waited, in {options.iterations} iterations: {waits}" if on_cuda else rows


def memory_of_way(bench: Bench, options: argparse.Namespace) -> float:
    """Return the peak in 10^9 bytes of two decisions of one way, with nothing of the other in memory."""
    way = Way(options.memory_of[0], int(options.memory_of[1]))
    if way.name == OFFICIAL:
        bench.keep_official_only()
    return peak_memory_gb(bench.decision(way, options.horizon[0]), options.device)


def memory_in_own_process(given: list[str], way: Way, horizon: int, dtype: str) -> float:
    """Return the peak memory of one way in a fresh process."""
    own = ["--horizon", str(horizon), "--dtype", dtype, "--memory-of", way.name, str(way.at_once)]
    return in_own_process(__file__, [*given, *own])


def _introduce(options: argparse.Namespace) -> None:
    load = ", ".join(f"{one:.1f}" for one in os.getloadavg())
    print(
        f"torch {torch.__version__}, {device_name(options.device)}, {torch.get_num_threads()} threads, load {load};"
        f" {options.layers} layers of width {options.width}, {options.image_size} px, {options.samples} samples x"
        f" {options.iterations} iterations, {options.repeats} repeats"
    )


if __name__ == "__main__":
    main()
