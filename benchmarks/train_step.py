"""How long does a training step take, and what share of the machine does it use? Ours against the official predictor's.

    python benchmarks/train_step.py --layers 4 --frames 8 16 --dtype float32 bfloat16 --official ../vjepa2
    python benchmarks/train_step.py --device cuda --batch 1 2 8 --checkpointing off on --attention flex per_step dense
    python benchmarks/train_step.py --device cuda --source cache pixels --batch 2 8 largest --cap-gb 24 --compile \
        --official ../vjepa2 --full --json benchmarks/results/train_step.json --profile

Ours is `training_step` itself on a LoRA of rank 16: loss, gradients, clipping, AdamW; latents are there already, or
with --encoder are computed from pixels. The baseline is the same step of the official code with plain PEFT LoRA
(`official.py`), where a checkout of facebookresearch/vjepa2 is at --official; before anything is timed both must give
the same loss and gradients on the same weights, else there is no ratio to it. Without a checkout the baseline is our
own step with a dense mask. A ratio over 1 means faster than the baseline.

All take turns, so that a busy machine slows them alike. On a CPU the process's own time over its threads counts, else
wall time. MFU: the model FLOPs of `training.cost.flops` over what the device does in a product of matrices, measured
first. Peak memory, weights included, is of two steps in a process of its own for each line; beside it, what `doctor`
estimates for our run of that setting, and by how much that is too much. What runs out of memory says so. --profile
counts, in a step of each way of ours, how often the host waits for the device, and what was compiled after warm-up;
beside it the seconds of a setting's first step, which compiles (it counts for the first setting of a process only).
"""

from __future__ import annotations

import argparse
import gc
import itertools
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from official import PREDICTOR
from timed_steps import OFFICIAL, OFFICIAL_FULL, PRECISIONS, Bench, Setting, has_checkout, our_ways
from timing import WAITS, add_options, device_name, in_own_process, peak_memory_gb, take_turns

from vjepa2_ac.model.lora import trainable_report
from vjepa2_ac.training.health import matmul_speed

TITLES = "{:>6} {:>5} {:>13}  {:16}{:>9}{:>9}{:>8}{:>9}{:>9}{:>7} {:>7}{:>9}"
TITLE_WORDS = (
    "frames", "batch", "checkpointing", "way", "ms", "clips/s", "MFU", "peak GB", "doctor", "off by", "source",
)  # fmt: skip
WAITS_ON = {
    "cuda": WAITS,
    "cpu": {"aten::_local_scalar_dense"},  # of which some ask no device: only whether counting works
}
QUICK = {
    "layers": 1, "width": 128, "latent_dim": 128, "encoder_layers": 1, "image_size": 64, "frames": [4], "batch": ["1"],
    "repeats": 1, "threads": 1,
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each setting and way: milliseconds, clips a second, MFU, peak memory, ratio to the baseline."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(given)
    if options.memory_of:
        print(json.dumps(memory_of_way(Bench(options, options.dtype[0]), options)))
        return
    _introduce(options)
    rows: list[dict[str, Any]] = []
    for dtype in options.dtype:
        bench = Bench(options, dtype)
        ways = choose_ways(bench, options)
        ceiling = matmul_speed(bench.device, bench.dtype)
        print(f"{dtype}: ceiling {ceiling / 1e12:.3g} TFLOP/s")
        print(TITLES.format(*TITLE_WORDS, f"of {ways[0]}"))
        for setting in settings(options, bench, ways[-1]):
            for row in measure(bench, setting, ways, ceiling):
                row["peak_gb"] = memory_in_own_process(given, setting, row["way"], dtype) if options.memory else None
                print(line(row), flush=True)
                rows.append({"dtype": dtype, "ceiling": ceiling, **row})
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        about = {"torch": torch.__version__, "device": device_name(options.device), "arguments": given, "rows": rows}
        options.json.write_text(json.dumps(about, indent=1) + "\n")


def measure(bench: Bench, setting: Setting, ways: list[str], ceiling: float) -> list[dict[str, Any]]:
    """Return what was measured of each way in a setting; of what runs out of memory, only that."""
    before, steps, first_s = compiled_graphs(), {}, {}
    for way in ways:
        began = time.perf_counter()
        step = fitting_step(bench, setting, way)
        if step is not None:
            steps[way], first_s[way] = step, time.perf_counter() - began
    for step in steps.values():  # once more: what is compiled for the second time is compiled here
        step()
    warm = compiled_graphs()
    seconds = take_turns(steps, bench.options) if steps else {}
    again = compiled_graphs() - warm
    rows = []
    for way in ways:
        row: dict[str, Any] = {**asdict(setting), "way": way, "estimate_gb": None, "ms": None}
        rows.append(row)
        if way not in steps:
            continue
        median = statistics.median(seconds[way])
        flops = setting.batch * bench.flops_per_clip(setting, way)
        row |= {
            "first_s": first_s[way],
            "ms": median * 1e3,
            "clips_per_s": setting.batch / median,
            "mfu": flops / median / ceiling,
        }
        if ways[0] in steps:
            pairs = zip(seconds[ways[0]], seconds[way], strict=True)
            row["ratio"] = statistics.median(base / own for base, own in pairs)
        if way not in {OFFICIAL, OFFICIAL_FULL}:
            if bench.device.type == "cuda":  # elsewhere the peak is the process's, with all of PyTorch
                row["estimate_gb"] = bench.estimated_gb(setting)
            if bench.options.profile:
                row |= {
                    "waits": waits(steps[way], bench.device.type),
                    "compiled_in_warm_up": warm - before,
                    "compiled_after": again,
                }
    return rows


def line(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    source = "pixels" if row["encoder"] else "cache"
    text = f"{row['frames']:6} {row['batch']:5} {'yes' if row['checkpointing'] else 'no':>13}  {row['way']:16}"
    if row["ms"] is None:
        return f"{text} out of memory ({source})"
    peak, estimate = row["peak_gb"] or math.nan, row["estimate_gb"] or math.nan
    text += f"{row['ms']:9.0f}{row['clips_per_s']:9.3f}{row['mfu']:8.1%}{peak:9.2f}{estimate:9.2f}"
    text += f"{estimate / peak - 1:+7.0%} {source:>7}"
    if "waits" in row:
        text += f"  [first step {row['first_s']:.1f} s, {row['waits']} waits,"
        text += f" {row['compiled_after']} compiled after warm-up]"
    return f"{text}{row.get('ratio', math.nan):9.2f}"


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layers", type=int, help="of the predictor (default: 24; 2 on a CPU)")
    parser.add_argument("--width", type=int, default=1024, help="of the predictor, 64 a head")
    parser.add_argument("--latent-dim", type=int, default=1408, help="width of the encoder, 64 a head")
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument(
        "--source",
        nargs="+",
        choices=("cache", "pixels"),
        default=["cache"],
        help="pixels: latents are made in the step",
    )
    parser.add_argument("--encoder", action="store_true", help="the same as --source pixels")
    parser.add_argument("--encoder-layers", type=int, help="with pixels (default: 40; 1 on a CPU)")
    parser.add_argument("--frames", type=int, nargs="+", default=[8, 16])
    parser.add_argument("--batch", nargs="+", default=["1"], help="numbers, or largest: what fits with the last way")
    parser.add_argument("--cap-gb", type=float, default=0.0, help="memory of the device that may be used; 0: all")
    parser.add_argument("--rollout-steps", type=int, default=2)
    parser.add_argument("--dtype", nargs="+", choices=tuple(PRECISIONS), default=["bfloat16"])
    parser.add_argument("--checkpointing", nargs="+", choices=("off", "on"), default=["off"])
    parser.add_argument("--attention", nargs="+", default=["auto"], help="auto, per_step, flex, dense: a line each")
    parser.add_argument("--compile", action="store_true", help="each way of ours once more with compiled blocks")
    parser.add_argument("--full", action="store_true", help="the official step that trains every weight, too")
    parser.add_argument("--profile", action="store_true", help="count waits for the device, and compilations")
    parser.add_argument("--json", type=Path, help="file for all figures")
    add_options(parser)
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.quick:
        vars(options).update(QUICK)
    if options.encoder and not options.memory_of:
        options.source = ["pixels"]
    if options.cap_gb and options.device != "cpu":
        whole = torch.cuda.get_device_properties(0).total_memory
        torch.cuda.set_per_process_memory_fraction(min(1.0, options.cap_gb * 1e9 / whole))
    on_cpu = options.device == "cpu"
    options.layers = options.layers or (2 if on_cpu else 24)
    options.encoder_layers = 1 if "pixels" not in options.source else options.encoder_layers or (1 if on_cpu else 40)
    if options.threads:
        torch.set_num_threads(options.threads)
    return options


def settings(options: argparse.Namespace, bench: Bench, way: str) -> Iterator[Setting]:
    """Yield all settings asked for; the largest batch is looked for with one of the ways."""
    asked = itertools.product(options.source, options.frames, options.checkpointing, options.batch)
    for source, frames, again, batch in asked:
        setting = Setting(frames, 1, again == "on", source == "pixels")
        yield replace(setting, batch=largest_batch(bench, setting, way) if batch == "largest" else int(batch))


def largest_batch(bench: Bench, setting: Setting, way: str, limit: int = 128) -> int:
    """Return the largest batch of which a step fits, 1 even where that does not; on a CPU nothing runs out: 2."""
    if bench.device.type == "cpu":
        return 2
    fits, too_large = 1, limit + 1
    while too_large - fits > 1:
        tried = min(2 * fits, (fits + too_large) // 2)
        if fitting_step(bench, replace(setting, batch=tried), way):
            fits = tried
        else:
            too_large = tried
    return fits


def fitting_step(bench: Bench, setting: Setting, way: str) -> Callable[[], object] | None:
    """Return a step that was done once, or None where it ran out of memory."""
    try:
        step = bench.step(setting, way)
        step()
    except torch.OutOfMemoryError:
        pass
    else:
        return step
    bench.forget_gradients()
    gc.collect()
    torch.cuda.empty_cache()
    return None


def compiled_graphs() -> int:
    """Return how many graphs PyTorch has compiled so far."""
    from torch._dynamo.utils import counters

    return int(counters["stats"]["unique_graphs"])


def waits(step: Callable[[], object], device: str) -> int:
    """Return how often the host asks the device for a number in one step, or waits for it otherwise."""
    with torch.profiler.profile() as profile:
        step()
    return sum(event.count for event in profile.key_averages() if event.key in WAITS_ON[device])


def choose_ways(bench: Bench, options: argparse.Namespace) -> list[str]:
    """Return the ways to compare, the baseline first; the official one only if it computes the same."""
    ours = our_ways(options.attention, compiled=options.compile)
    print(f"ours: {trainable_report(bench.model)}")
    if has_checkout(options):
        count = sum(parameter.numel() for parameter in bench.official.trained)
        print(f"official with plain PEFT LoRA on fused q, k, v: {count:,} parameters are trained")
        found = bench.compare()
        if found is None:
            print("official: the same loss and gradients on the same weights (float32)")
            return [OFFICIAL, *([OFFICIAL_FULL] if options.full else []), *ours]
        print(f"official: NO RATIO, for it does not compute the same: {found}")
    else:
        print(f"official: skipped, for there is no {options.official / PREDICTOR}")
    return ["dense", *(way for way in ours if way != "dense")]


def memory_of_way(bench: Bench, options: argparse.Namespace) -> float:
    """Return the peak in 10^9 bytes of two steps of one way, with nothing of the other in memory."""
    setting = next(settings(options, bench, options.memory_of))
    step = bench.step(setting, options.memory_of)
    if options.memory_of in {OFFICIAL, OFFICIAL_FULL}:
        del bench.model
    elif "official" in vars(bench):
        del bench.official
    bench._weights = None
    try:
        return peak_memory_gb(step, options.device)
    except torch.OutOfMemoryError:
        return math.nan


def memory_in_own_process(given: list[str], setting: Setting, way: str, dtype: str) -> float:
    """Return the peak memory of one way in a fresh process."""
    again = "on" if setting.checkpointing else "off"
    own = [
        "--frames", str(setting.frames), "--batch", str(setting.batch), "--checkpointing", again, "--dtype", dtype,
        "--source", "pixels" if setting.encoder else "cache", "--memory-of", way,
    ]  # fmt: skip
    return in_own_process(__file__, [*given, *own])


def _introduce(options: argparse.Namespace) -> None:
    print(f"torch {torch.__version__}, {device_name(options.device)}, {torch.get_num_threads()} threads")
    latents = f"{options.encoder_layers} of encoder where it is in the step"
    print(
        f"{options.layers} layers of width {options.width}, {latents}, {options.image_size} px,"
        f" rollout of {options.rollout_steps}, {options.repeats} repeats"
        + (f", at most {options.cap_gb:g} GB" if options.cap_gb else "")
    )


if __name__ == "__main__":
    main()
