"""How long does a training step take, and what share of the machine does it use? Ours against the official predictor's.

    python benchmarks/train_step.py --layers 4 --frames 8 16 --dtype float32 bfloat16 --official ../vjepa2
    python benchmarks/train_step.py --device cuda --batch 1 2 8 --checkpointing off on --attention flex per_step dense
    python benchmarks/train_step.py --device cuda --batch 8 --encoder

Ours is `training_step` itself on a LoRA of rank 16: loss, gradients, clipping, AdamW; latents are there already, or
with --encoder are computed from pixels. The baseline is the same step of the official code with plain PEFT LoRA
(`official.py`), where a checkout of facebookresearch/vjepa2 is at --official; before anything is timed both must give
the same loss and gradients on the same weights, else there is no ratio to it. Without a checkout the baseline is our
own step with a dense mask. A ratio over 1 means faster than the baseline.

All take turns, so that a busy machine slows them alike. On a CPU the process's own time over its threads counts, else
wall time. MFU: the model FLOPs of `training.cost.flops` over what the device does in a product of matrices, measured
first. Peak memory, weights included, is of two steps in a process of its own for each line.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from official import PREDICTOR
from timed_steps import OFFICIAL, PRECISIONS, Bench, Setting, has_checkout
from timing import device_name, in_own_process, peak_memory_gb, take_turns

from vjepa2_ac.model.lora import trainable_report
from vjepa2_ac.training.health import matmul_speed

BESIDE = Path(__file__).resolve().parents[2] / "vjepa2"
QUICK = {
    "layers": 1, "width": 128, "latent_dim": 128, "encoder_layers": 1, "image_size": 64, "frames": [4], "batch": [1],
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
    for dtype in options.dtype:
        bench = Bench(options, dtype)
        ways = choose_ways(bench, options)
        ceiling = matmul_speed(bench.device, bench.dtype)
        print(f"{dtype}: ceiling {ceiling / 1e12:.3g} TFLOP/s")
        titles = ("ms", "clips/s", "MFU", "peak GB", f"of {ways[0]}")
        print(
            f"{'frames':>6} {'batch':>5} {'checkpointing':>13}  {'way':9}" + "".join(f"{title:>12}" for title in titles)
        )
        for setting in settings(options):
            seconds = take_turns({way: bench.step(setting, way) for way in ways}, options)
            flops = setting.batch * bench.flops_per_clip(setting)
            for way in ways:
                median = statistics.median(seconds[way])
                ratio = statistics.median(b / o for b, o in zip(seconds[ways[0]], seconds[way], strict=True))
                peak = memory_in_own_process(given, setting, way, dtype) if options.memory else math.nan
                print(
                    f"{setting.frames:6} {setting.batch:5} {'yes' if setting.checkpointing else 'no':>13}  {way:9}"
                    f"{median * 1e3:12.0f}{setting.batch / median:12.3f}{flops / median / ceiling:12.1%}"
                    f"{peak:12.2f}{ratio:12.2f}",
                    flush=True,
                )


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="tiny sizes: whether it works")
    parser.add_argument("--official", type=Path, default=BESIDE, help="checkout (default: vjepa2 beside this project)")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--layers", type=int, help="of the predictor (default: 24; 2 on a CPU)")
    parser.add_argument("--width", type=int, default=1024, help="of the predictor, 64 a head")
    parser.add_argument("--latent-dim", type=int, default=1408, help="width of the encoder, 64 a head")
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument("--encoder", action="store_true", help="compute latents in the step")
    parser.add_argument("--encoder-layers", type=int, help="with --encoder (default: 40; 1 on a CPU)")
    parser.add_argument("--frames", type=int, nargs="+", default=[8, 16])
    parser.add_argument("--batch", type=int, nargs="+", default=[1])
    parser.add_argument("--rollout-steps", type=int, default=2)
    parser.add_argument("--dtype", nargs="+", choices=tuple(PRECISIONS), default=["bfloat16"])
    parser.add_argument("--checkpointing", nargs="+", choices=("off", "on"), default=["off"])
    parser.add_argument("--attention", nargs="+", default=["auto"], help="auto, per_step, flex, dense: a line each")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--warm-up", type=int, default=1, help="rounds that do not count")
    parser.add_argument("--threads", type=int, default=0, help="0: as torch chooses")
    parser.add_argument("--memory", action=argparse.BooleanOptionalAction, default=True, help="measure peak memory too")
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.quick:
        vars(options).update(QUICK)
    on_cpu = options.device == "cpu"
    options.layers = options.layers or (2 if on_cpu else 24)
    options.encoder_layers = 1 if not options.encoder else options.encoder_layers or (1 if on_cpu else 40)
    if options.threads:
        torch.set_num_threads(options.threads)
    return options


def settings(options: argparse.Namespace) -> list[Setting]:
    """Return all settings asked for."""
    asked = itertools.product(options.frames, options.batch, options.checkpointing)
    return [Setting(frames, batch, again == "on") for frames, batch, again in asked]


def choose_ways(bench: Bench, options: argparse.Namespace) -> list[str]:
    """Return the ways to compare, the baseline first; the official one only if it computes the same."""
    print(f"ours: {trainable_report(bench.model)}")
    if has_checkout(options):
        count = sum(parameter.numel() for parameter in bench.official.trained)
        print(f"official with plain PEFT LoRA on fused q, k, v: {count:,} parameters are trained")
        found = bench.compare()
        if found is None:
            print("official: the same loss and gradients on the same weights (float32)")
            return [OFFICIAL, *options.attention]
        print(f"official: NO RATIO, for it does not compute the same: {found}")
    else:
        print(f"official: skipped, for there is no {options.official / PREDICTOR}")
    return ["dense", *(way for way in options.attention if way != "dense")]


def memory_of_way(bench: Bench, options: argparse.Namespace) -> float:
    """Return the peak in 10^9 bytes of two steps of one way, with nothing of the other in memory."""
    step = bench.step(settings(options)[0], options.memory_of)
    if options.memory_of == OFFICIAL:
        del bench.model
    elif "official" in vars(bench):
        del bench.official
    bench._weights = None
    return peak_memory_gb(step, options.device)


def memory_in_own_process(given: list[str], setting: Setting, way: str, dtype: str) -> float:
    """Return the peak memory of one way in a fresh process."""
    again = "on" if setting.checkpointing else "off"
    own = [
        "--frames", str(setting.frames), "--batch", str(setting.batch), "--checkpointing", again, "--dtype", dtype,
        "--memory-of", way,
    ]  # fmt: skip
    return in_own_process(__file__, [*given, *own])


def _introduce(options: argparse.Namespace) -> None:
    print(f"torch {torch.__version__}, {device_name(options.device)}, {torch.get_num_threads()} threads")
    latents = f"latents from {options.encoder_layers} layers of encoder" if options.encoder else "latents from a cache"
    print(
        f"{options.layers} layers of width {options.width}, {options.image_size} px, {latents},"
        f" rollout of {options.rollout_steps}, {options.repeats} repeats"
    )


if __name__ == "__main__":
    main()
