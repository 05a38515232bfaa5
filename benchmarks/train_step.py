"""Measure time and utilisation of a training step, compared with the official predictor's.

    python benchmarks/train_step.py --layers 4 --frames 8 16 --dtype float32 bfloat16 --official ../vjepa2
    python benchmarks/train_step.py --device cuda --batch 1 2 8 --checkpointing off on --attention auto per_step dense
    python benchmarks/train_step.py --device cuda --source cache pixels --batch 2 8 largest --cap-gb 24 --compile \
        --official ../vjepa2 --full --json benchmarks/results/train_step.json --profile

Ours is `training_step` itself on a LoRA of rank 16: loss, gradients, clipping, AdamW; latents are there already, or
with --source pixels are computed in the step. The baseline is the same step of the official code with plain PEFT LoRA
(`official_predictor.py`), where a checkout of facebookresearch/vjepa2 is at --official; before anything is timed both
must give the same loss and gradients on the same weights, else there is no ratio to it. Without a checkout the
baseline is our own step with a dense mask. A ratio over 1 means faster than the baseline.

All take turns, so that a busy machine slows them alike. On a CPU the process's own time over its threads counts, else
wall time; `ms` is the median, `min` the fastest. MFU: the model FLOPs of `training.flops` over what the device
does in a product of matrices, measured first. `retries`: how often the allocator had to give memory back while a way
was timed, whose time then does not count. --profile counts, in a step of each way of ours, how often the host waits
for the device, how long its kernels ran, and what was compiled after warm-up; beside it the seconds of a setting's
first step, which compiles (it counts for the first setting of a process only). Loss and norm of the gradients must be
the same for all ways of ours, but for bfloat16's rounding.

Peak memory, weights included, is of two steps in a pass of its own, after all times: each line alone on the device, or
on a CPU in a process of its own. Beside it, what `doctor` estimates for our run of that setting, and by how much that
is too much. --cap-gb holds there, and where the largest batch is looked for; not while anything is timed.

--json is written after every round. What runs out of memory says so; what fails otherwise, too, and the exit status is
1 then, when all else was measured.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial

from memory import is_expandable, let_go
from official_predictor import PREDICTOR
from rows import Row, Rows, cell, problem_of
from step_memory import MEMORY_TITLES, NAMES, asked, found, memory_line, memory_of_way, memory_row, names_of
from timing import Turns, about, add_options, introduction, prepare, profiled, ratio, rounds, settle
from train_step_variants import OFFICIAL, OFFICIAL_FULL, PRECISIONS, Bench, Setting, Started, has_checkout, our_ways

from vjepa2_ac.distributed import measure_matmul_speed
from vjepa2_ac.model.lora import trainable_report

QUICK = {
    "layers": 1, "width": 128, "latent_dim": 128, "encoder_layers": 1, "image_size": 64, "frames": [4], "batch": ["1"],
    "repeats": 1, "threads": 1,
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each setting and way: milliseconds, clips a second, MFU, ratio to the baseline; peak memory."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(given)
    prepare(options)
    if options.memory_of:
        (setting,) = asked(options)
        print(json.dumps(memory_of_way(options, options.dtype[0], setting, options.memory_of)))
        return
    _introduce(options)
    rows = Rows(options.json, **about(options, given))
    for dtype in options.dtype:
        rows.attempt(partial(measure, options, given, dtype, rows), dtype=dtype)
    rows.finish()


def measure(options: argparse.Namespace, given: list[str], dtype: str, rows: Rows) -> None:
    """Measure all settings in one precision: first time, then memory."""
    settings = [setting for one in asked(options) for setting in found(options, dtype, one, rows)]
    ways = measure_time(options, dtype, settings, rows)
    let_go(options.device)
    if options.memory:
        print(f"{dtype}, memory\n{MEMORY_TITLES}")
        for setting, way in itertools.product(settings, ways):
            row = memory_row(options, given, dtype, setting, way)
            rows.add(row)
            print(memory_line(row), flush=True)


def measure_time(options: argparse.Namespace, dtype: str, settings: Sequence[Setting], rows: Rows) -> list[str]:
    """Time all settings, if that is asked for, and return the ways that are compared; nothing stays on the device."""
    bench = Bench(options, dtype)
    ways = choose_ways(bench, options, rows)
    rows.about["expandable_segments"] = is_expandable(options.device)
    if options.time:
        ceiling = measure_matmul_speed(bench.device, bench.dtype)
        print(f"{dtype}: ceiling {ceiling / 1e12:.3g} TFLOP/s")
        titles = f"{'ms':>9}{'min':>9}{'clips/s':>9}{'MFU':>8}{'retries':>8}{f'of {ways[0]}':>15}"
        print(f"{NAMES}{titles}{'loss':>10}{'gradients':>10}")
        for setting in settings:
            rows.attempt(partial(time_setting, bench, setting, ways, ceiling, rows), dtype=dtype, **asdict(setting))
    return ways


def time_setting(bench: Bench, setting: Setting, ways: Sequence[str], ceiling: float, rows: Rows) -> None:
    """Add a row for each way."""
    let_go(bench.options.device)
    before = compiled_graphs()
    started = {way: bench.start(setting, way) for way in ways}
    warm = compiled_graphs()
    seen: dict[str, Turns] = {}  # nothing before the first round is over

    def rows_so_far() -> list[Row]:
        base = seen.get(ways[0])
        return [time_row(bench, setting, way, started[way], seen.get(way), base, ceiling) for way in ways]

    steps = {way: one.step for way, one in started.items() if one.step}
    for so_far in rounds(steps, bench.options, bench.let_go_of_a_step):
        seen = so_far
        rows.so_far(*rows_so_far())
    compiled = {"compiled_in_warm_up": warm - before, "compiled_after": compiled_graphs() - warm}
    for row in rows_so_far():
        if row["problem"] is None and bench.options.profile and row["way"] not in {OFFICIAL, OFFICIAL_FULL}:
            row |= {**compiled, **seen_by_the_profiler(steps[row["way"]], bench)}
        rows.add(row)
        print(time_line(row), flush=True)


def time_row(
    bench: Bench, setting: Setting, way: str, started: Started, turns: Turns | None, base: Turns | None, ceiling: float
) -> Row:
    """Return what was seen of a way so far."""
    figures = (turns or Turns(failure=started.problem)).figures()
    seconds = figures["s"]
    flops = setting.batch * bench.flops_per_clip(setting, way)
    return {
        "measured": "time", "dtype": str(bench.dtype).removeprefix("torch."), "ceiling": ceiling, **asdict(setting),
        "way": way, **figures, "first_s": started.first_s, **started.found, "ratio": ratio(base, turns),
        "clips_per_s": seconds and setting.batch / seconds, "mfu": seconds and flops / seconds / ceiling,
    }  # fmt: skip


def seen_by_the_profiler(step: Callable[[], object], bench: Bench) -> Row:
    """Return how often the host waits for the device in a step, and its dearest kernels, or how profiling failed."""
    try:
        found = profiled(step, bench.options.device)
        return {
            "waits": sum(found.waits.values()),
            "busy_ms": found.busy_ms(),
            "dearest": found.dearest(bench.options.device),
        }
    except Exception as error:
        problem = problem_of(error)
    bench.let_go_of_a_step()
    return {"waits": problem}


def time_line(row: Row) -> str:
    """Return a row of the table of times."""
    if row["problem"]:
        return f"{names_of(row)}{row['problem']}"
    milliseconds = "".join(cell(row[key] * 1e3, 9, ".1f") for key in ("s", "min_s"))
    text = f"{names_of(row)}{milliseconds}{row['clips_per_s']:9.3f}{row['mfu']:8.1%}{row['alloc_retries']:8}"
    text += cell(row["ratio"], 15, ".2f")
    if "loss" in row:
        text += f"{row['loss']:10.5f}{row['grad_norm']:10.5f}"
    if "waits" in row:
        text += f"  [first step {row['first_s']:.1f} s, {row['waits']} waits,"
        text += f" {row.get('busy_ms') or 0:.0f} ms of kernels,"
        text += f" {row['compiled_after']} compiled after warm-up]"
    return text


def compiled_graphs() -> int:
    """Return how many graphs PyTorch has compiled so far."""
    from torch._dynamo.utils import counters

    return int(counters["stats"]["unique_graphs"])


def choose_ways(bench: Bench, options: argparse.Namespace, rows: Rows) -> list[str]:
    """Return the ways to compare, the baseline first; the official one only if it computes the same."""
    ours = our_ways(options.attention, compiled=options.compile)
    plain = ["dense", *(way for way in ours if way != "dense")] if options.time else ours  # memory has no baseline
    print(f"ours: {trainable_report(bench.model)}")
    if not has_checkout(options):
        print(f"official: skipped, needs {options.official / PREDICTOR}, found no such file")
        return plain
    named = {"measured": "same loss and gradients", "dtype": str(bench.dtype).removeprefix("torch."), "way": OFFICIAL}
    if rows.attempt(partial(is_official_the_same, bench, rows, named), **named):
        return [OFFICIAL, *([OFFICIAL_FULL] if options.full else []), *ours]
    bench.keep_only(plain[0])
    bench.let_go_of_a_step()
    return plain


def is_official_the_same(bench: Bench, rows: Rows, named: Row) -> bool:
    """Return whether the official predictor computes the same, and print the result."""
    difference = bench.compare()
    rows.add({**named, "difference": difference})
    count = sum(parameter.numel() for parameter in bench.official.trained)
    print(f"official with plain PEFT LoRA on fused q, k, v: {count:,} parameters are trained")
    if difference is None:
        print("official: the same loss and gradients on the same weights (float32)")
        return True
    print(f"official: no ratio is reported, because the results differ: {difference}")
    return False


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layers", type=int, help="layers of the predictor (default: 24; 2 on a CPU)")
    parser.add_argument("--width", type=int, default=1024, help="width of the predictor, a multiple of 64")
    parser.add_argument("--latent-dim", type=int, default=1408, help="width of the encoder, a multiple of 64")
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument(
        "--source",
        nargs="+",
        choices=("cache", "pixels"),
        default=["cache"],
        help="pixels: frames are encoded in the step",
    )
    parser.add_argument("--encoder", action="store_true", help="the same as --source pixels")
    parser.add_argument(
        "--encoder-layers", type=int, help="layers of the encoder, with --source pixels (default: 40; 1 on a CPU)"
    )
    parser.add_argument("--frames", type=int, nargs="+", default=[8, 16])
    parser.add_argument(
        "--batch", nargs="+", default=["1"], help="batch sizes, or largest: the largest that fits with the last variant"
    )
    parser.add_argument("--cap-gb", type=float, default=0.0, help="memory limit, except for timing; 0: no limit")
    parser.add_argument("--rollout-steps", type=int, default=2)
    parser.add_argument("--dtype", nargs="+", choices=tuple(PRECISIONS), help="default: bfloat16; CPU: float32")
    parser.add_argument("--checkpointing", nargs="+", choices=("off", "on"), default=["off"])
    parser.add_argument(
        "--attention", nargs="+", default=["auto"], help="auto, per_step, flex, dense, or auto+graph; one row each"
    )
    parser.add_argument(
        "--compile", action="store_true", help="also measure each variant of this package with compiled blocks"
    )
    parser.add_argument("--full", action="store_true", help="also measure the official step with full fine-tuning")
    parser.add_argument("--profile", action="store_true", help="count device synchronisations and compilations")
    add_options(parser)
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    options = settle(parser.parse_args(arguments), QUICK)
    if options.encoder and not options.memory_of:
        options.source = ["pixels"]
    on_cpu = options.device == "cpu"
    options.layers = options.layers or (2 if on_cpu else 24)
    options.dtype = options.dtype or ["float32" if on_cpu else "bfloat16"]
    options.encoder_layers = 1 if "pixels" not in options.source else options.encoder_layers or (1 if on_cpu else 40)
    return options


def _introduce(options: argparse.Namespace) -> None:
    latents = f"{options.encoder_layers} of encoder where it is in the step"
    print(introduction(options))
    print(
        f"{options.layers} layers of width {options.width}, {latents}, {options.image_size} px,"
        f" rollout of {options.rollout_steps}, {options.repeats} repeats after {options.warm_up}"
        + (f"; memory: at most {options.cap_gb:g} GB" if options.cap_gb else "")
    )


if __name__ == "__main__":
    main()
