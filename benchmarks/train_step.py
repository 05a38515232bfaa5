"""Measure time, memory and utilisation of a training step, compared with the official code.

    python benchmarks/train_step.py --layers 4 --frames 8 16 --dtype float32 bfloat16 --official ../vjepa2
    python benchmarks/train_step.py --device cuda --batch 1 2 8 --checkpointing off on --attention auto per_step dense
    python benchmarks/train_step.py --device cuda --source cache pixels --batch 2 8 largest --cap-gb 24 --compile \
        --official ../vjepa2 --full --json benchmarks/results/train_step.json --profile

The step of this package is `training_step` with a LoRA of rank 16: loss, gradients, clipping, AdamW. Latents are
cached, or computed in the step with --source pixels. The baseline is the same step of the official code with plain PEFT
LoRA (`official_predictor.py`); it needs a checkout of facebookresearch/vjepa2 at --official. A ratio is reported only
if both steps give the same loss and gradients with the same weights. Without a checkout the baseline is the step of
this package with a dense mask. A ratio above 1 means faster than the baseline.

The variants take turns, so that load on the machine slows all of them equally. On a CPU the process time divided by the
number of threads is measured, otherwise wall time. `ms` is the median, `min` the shortest time. `MFU` is the number of
model FLOPs (`training.flops`), divided by the FLOPs that the device computes in the same time in a matrix product.
`retries` counts how often the allocator had to release memory while a variant was timed; its time is then invalid.
--profile counts how often the host waits for the device in a step, and measures the duration of the kernels. It also
reports the number of graphs compiled after the warm-up, and the duration of the first step, which includes compilation
in the first setting of a process. The variants of this package must have the same loss and gradient norm, up to the
rounding of bfloat16.

The peak memory of two steps, including the weights, is measured after all times: each line alone on the device, or in a
new process on a CPU. The table compares it with the estimate of `doctor`. --cap-gb limits the memory in this pass and
in the search for the largest batch, but not while steps are timed.

--json is written after every round. A variant that runs out of memory or fails is reported, and the others continue.
After any other failure than a lack of memory the exit status is 1.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial

from memory import is_expandable, release_memory
from official_predictor import PREDICTOR
from rows import Row, Rows, describe_failure, format_cell
from step_memory import (
    MEMORY_TITLES,
    NAMES,
    format_memory_line,
    format_names,
    list_settings,
    measure_memory_row,
    measure_variant_memory,
    resolve_batch,
)
from timing import (
    Timings,
    add_options,
    apply_defaults,
    compute_speed_up,
    describe_machine,
    describe_run,
    profile_step,
    set_up_torch,
    time_rounds,
)
from train_step_variants import OFFICIAL, OFFICIAL_FULL, PRECISIONS, Bench, Setting, WarmUp, has_checkout, our_variants

from vjepa2_ac.distributed import measure_matmul_speed
from vjepa2_ac.model.lora import trainable_report

QUICK = {
    "layers": 1, "width": 128, "latent_dim": 128, "encoder_layers": 1, "image_size": 64, "frames": [4], "batch": ["1"],
    "repeats": 1, "threads": 1,
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each setting and variant: times, clips per second, MFU, ratio to the baseline, peak memory."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(arguments)
    set_up_torch(options)
    if options.memory_of:
        (setting,) = list_settings(options)
        print(json.dumps(measure_variant_memory(options, options.dtype[0], setting, options.memory_of)))
        return
    _introduce(options)
    rows = Rows(options.json, **describe_run(options, arguments))
    for dtype in options.dtype:
        rows.attempt(partial(measure, options, arguments, dtype, rows), dtype=dtype)
    rows.finish()


def measure(options: argparse.Namespace, arguments: list[str], dtype: str, rows: Rows) -> None:
    """Measure all settings in one precision: first the times, then the memory."""
    settings = [
        setting for requested in list_settings(options) for setting in resolve_batch(options, dtype, requested, rows)
    ]
    variants = measure_time(options, dtype, settings, rows)
    release_memory(options.device)
    if options.memory:
        print(f"{dtype}, memory\n{MEMORY_TITLES}")
        for setting, variant in itertools.product(settings, variants):
            row = measure_memory_row(options, arguments, dtype, setting, variant)
            rows.add(row)
            print(format_memory_line(row), flush=True)


def measure_time(options: argparse.Namespace, dtype: str, settings: Sequence[Setting], rows: Rows) -> list[str]:
    """Time all settings, if --time is set, and return the names of the compared variants."""
    bench = Bench(options, dtype)
    variants = choose_variants(bench, options, rows)
    rows.about["expandable_segments"] = is_expandable(options.device)
    if options.time:
        ceiling = measure_matmul_speed(bench.device, bench.dtype)
        print(f"{dtype}: ceiling {ceiling / 1e12:.3g} TFLOP/s")
        titles = f"{'ms':>9}{'min':>9}{'clips/s':>9}{'MFU':>8}{'retries':>8}{f'of {variants[0]}':>15}"
        print(f"{NAMES}{titles}{'loss':>10}{'gradients':>10}")
        for setting in settings:
            rows.attempt(partial(time_setting, bench, setting, variants, ceiling, rows), dtype=dtype, **asdict(setting))
    return variants


def time_setting(bench: Bench, setting: Setting, variants: Sequence[str], ceiling: float, rows: Rows) -> None:
    """Add a row for each variant."""
    release_memory(bench.options.device)
    before = count_compiled_graphs()
    warm_ups = {variant: bench.warm_up(setting, variant) for variant in variants}
    after_warm_up = count_compiled_graphs()
    timings: dict[str, Timings] = {}  # empty until the first timed round is finished

    def make_rows() -> list[Row]:
        base = timings.get(variants[0])
        return [
            make_time_row(bench, setting, variant, warm_ups[variant], timings.get(variant), base, ceiling)
            for variant in variants
        ]

    steps = {variant: warm_up.step for variant, warm_up in warm_ups.items() if warm_up.step}
    for timings_so_far in time_rounds(steps, bench.options, bench.clear_failed_step):
        timings.update(timings_so_far)
        rows.write_unfinished(*make_rows())
    compiled = {
        "compiled_in_warm_up": after_warm_up - before,
        "compiled_after": count_compiled_graphs() - after_warm_up,
    }
    for row in make_rows():
        if row["problem"] is None and bench.options.profile and row["variant"] not in {OFFICIAL, OFFICIAL_FULL}:
            row |= {**compiled, **profile_row(steps[row["variant"]], bench)}
        rows.add(row)
        print(format_time_line(row), flush=True)


def make_time_row(
    bench: Bench,
    setting: Setting,
    variant: str,
    warm_up: WarmUp,
    timings: Timings | None,
    base: Timings | None,
    ceiling: float,
) -> Row:
    """Return the row of a variant after the rounds so far. `base` are the timings of the baseline."""
    metrics = (timings or Timings(failure=warm_up.problem)).metrics()
    seconds = metrics["s"]
    flops = setting.batch * bench.flops_per_clip(setting, variant)
    return {
        "measured": "time", "dtype": str(bench.dtype).removeprefix("torch."), "ceiling": ceiling, **asdict(setting),
        "variant": variant, **metrics, "first_s": warm_up.first_s, **warm_up.metrics,
        "ratio": compute_speed_up(base, timings),
        "clips_per_s": seconds and setting.batch / seconds, "mfu": seconds and flops / seconds / ceiling,
    }  # fmt: skip


def profile_row(step: Callable[[], object], bench: Bench) -> Row:
    """Return how often the host waits for the device in a step, and the slowest kernels; or why profiling failed."""
    try:
        profile = profile_step(step, bench.options.device)
        return {
            "waits": sum(profile.waits.values()),
            "busy_ms": profile.busy_ms(),
            "slowest": profile.slowest(bench.options.device),
        }
    except Exception as error:
        problem = describe_failure(error)
    bench.clear_failed_step()
    return {"waits": problem}


def format_time_line(row: Row) -> str:
    """Return a line of the table of times."""
    if row["problem"]:
        return f"{format_names(row)}{row['problem']}"
    milliseconds = "".join(format_cell(row[key] * 1e3, 9, ".1f") for key in ("s", "min_s"))
    text = f"{format_names(row)}{milliseconds}{row['clips_per_s']:9.3f}{row['mfu']:8.1%}{row['alloc_retries']:8}"
    text += format_cell(row["ratio"], 15, ".2f")
    if "loss" in row:
        text += f"{row['loss']:10.5f}{row['grad_norm']:10.5f}"
    if "waits" in row:
        text += f"  [first step {row['first_s']:.1f} s, {row['waits']} waits,"
        text += f" {row.get('busy_ms') or 0:.0f} ms of kernels,"
        text += f" {row['compiled_after']} compiled after warm-up]"
    return text


def count_compiled_graphs() -> int:
    """Return how many graphs PyTorch has compiled so far."""
    from torch._dynamo.utils import counters

    return int(counters["stats"]["unique_graphs"])


def choose_variants(bench: Bench, options: argparse.Namespace, rows: Rows) -> list[str]:
    """Return the variants to compare, the baseline first; the official code only if its results are the same."""
    ours = our_variants(options.attention, compiled=options.compile)
    without_official = ours
    if options.time:  # memory is compared without a baseline
        without_official = ["dense", *(variant for variant in ours if variant != "dense")]
    print(f"ours: {trainable_report(bench.model)}")
    if not has_checkout(options):
        print(f"official: skipped, needs {options.official / PREDICTOR}, found no such file")
        return without_official
    about = {
        "measured": "same loss and gradients",
        "dtype": str(bench.dtype).removeprefix("torch."),
        "variant": OFFICIAL,
    }
    if rows.attempt(partial(matches_official, bench, rows, about), **about):
        return [OFFICIAL, *([OFFICIAL_FULL] if options.full else []), *ours]
    bench.keep_only(without_official[0])
    bench.clear_failed_step()
    return without_official


def matches_official(bench: Bench, rows: Rows, about: Row) -> bool:
    """Return whether the official predictor gives the same loss and gradients, and print the result."""
    difference = bench.compare()
    rows.add({**about, "difference": difference})
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
    options = apply_defaults(parser.parse_args(arguments), QUICK)
    if options.encoder and not options.memory_of:
        options.source = ["pixels"]
    on_cpu = options.device == "cpu"
    options.layers = options.layers or (2 if on_cpu else 24)
    options.dtype = options.dtype or ["float32" if on_cpu else "bfloat16"]
    options.encoder_layers = 1 if "pixels" not in options.source else options.encoder_layers or (1 if on_cpu else 40)
    return options


def _introduce(options: argparse.Namespace) -> None:
    print(describe_machine(options))
    print(
        f"{options.layers} layers of width {options.width}, encoder of {options.encoder_layers} layers (source pixels),"
        f" {options.image_size} px,"
        f" rollout of {options.rollout_steps}, {options.repeats} repeats after {options.warm_up}"
        + (f"; memory: at most {options.cap_gb:g} GB" if options.cap_gb else "")
    )


if __name__ == "__main__":
    main()
