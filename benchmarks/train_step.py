"""How long does a training step of the predictor take? LoRA, forward and backward, against the plain way to compute it.

    python benchmarks/train_step.py --frames 8 16 --dtype float32 --layers 24
    python benchmarks/train_step.py --device cuda --dtype bfloat16 --batch 2 --checkpointing

The baseline is the same step with a dense attention mask and rotary tables computed again in every layer, as upstream
computes it. The two take turns, so that a busy machine slows both; a ratio over 1 means faster than the baseline. The
step is the teacher-forced loss over frames - 1 steps. Peak memory is measured in a process of its own for each variant.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vjepa2_ac.config import AdapterConfig, EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.model import positions
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.world_model import WorldModel

BASELINE, OURS = "dense mask, tables per layer", "as in training"
VARIANTS = (BASELINE, OURS)


def main() -> None:
    """Print a table: milliseconds, samples per second, peak memory and the ratio to the baseline."""
    options = parse()
    if options.memory_of:
        print(json.dumps(measure_memory(options)))
        return
    print(f"torch {torch.__version__}, {device_name(options.device)}, {torch.get_num_threads()} threads")
    print(
        f"{options.layers} layers of width {options.width}, {options.image_size} px, batch {options.batch},"
        f" {options.dtype}{', gradient checkpointing' if options.checkpointing else ''}, {options.repeats} repeats"
    )
    print(f"{'frames':>6}  {'variant':30} {'ms (median)':>11} {'samples/s':>9} {'peak GB':>8} {'ratio':>6}")
    for frames in options.frames:
        times = measure_times(options, frames)
        for variant in VARIANTS:
            seconds = statistics.median(times[variant])
            ratio = statistics.median(b / o for b, o in zip(times[BASELINE], times[variant], strict=True))
            peak = peak_in_own_process(frames, variant) if options.memory else float("nan")
            speed = options.batch / seconds
            line = f"{frames:>6}  {variant:30} {seconds * 1e3:11.0f} {speed:9.3f} {peak:8.2f} {ratio:6.2f}"
            print(line, flush=True)


def parse() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layers", type=int, default=24)
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument("--frames", type=int, nargs="+", default=[8, 16])
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--dtype", choices=("float32", "bfloat16"), default="float32")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0, help="0: as torch chooses")
    parser.add_argument("--attention", default="auto", help="of our variant: auto, per_step, flex or dense")
    parser.add_argument("--checkpointing", action="store_true", help="gradient checkpointing, in both variants")
    parser.add_argument("--memory", action=argparse.BooleanOptionalAction, default=True, help="measure peak memory too")
    parser.add_argument("--memory-of", choices=VARIANTS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.threads:
        torch.set_num_threads(options.threads)
    return options


def build(options: argparse.Namespace) -> WorldModel:
    """Return a model of the released predictor's shape with the default adapter; its encoder is never used."""
    sizes = ModelSizes(
        image_size=options.image_size,
        encoder=EncoderSizes(depth=1),
        predictor=PredictorSizes(depth=options.layers, width=options.width),
    )
    model = WorldModel.random(sizes, seed=0, dtype=getattr(torch, options.dtype))
    add_adapter(model, AdapterConfig(), seed=0)
    model.set_gradient_checkpointing(options.checkpointing)
    return model.to(options.device).train()


def inputs(options: argparse.Namespace, model: WorldModel, frames: int) -> tuple[Tensor, Tensor]:
    """Return latents of `frames` frames, and one less poses that serve as actions and states."""
    generator = torch.Generator().manual_seed(0)
    latents = torch.randn(options.batch, frames, model.num_tokens, model.latent_dim, generator=generator)
    poses = torch.randn(options.batch, frames - 1, 7, generator=generator)
    return latents.to(options.device), poses.to(options.device)


def step(model: WorldModel, latents: Tensor, poses: Tensor, dtype: str) -> None:
    """Compute the teacher-forced loss and its gradients."""
    mixed = torch.autocast(latents.device.type, torch.bfloat16, enabled=dtype == "bfloat16")
    with mixed:
        loss = (model.predict(latents[:, :-1], poses, poses) - latents[:, 1:]).abs().mean()
    loss.backward()
    model.zero_grad(set_to_none=True)
    if latents.is_cuda:
        torch.cuda.synchronize()


@contextlib.contextmanager
def computing(model: WorldModel, variant: str, attention: str) -> Iterator[None]:
    """Make the model compute as the variant says."""
    model.set_attention("dense" if variant == BASELINE else attention)
    inner = [block.attn for block in model.base_predictor.blocks]
    plain = [attn.forward for attn in inner]
    if variant == BASELINE:
        for attn in inner:
            attn.forward = _with_own_tables(attn)
    try:
        yield
    finally:
        for attn, forward in zip(inner, plain, strict=True):
            attn.forward = forward


def _with_own_tables(attn: Any) -> Callable[..., Tensor]:
    forward = attn.forward
    uncached = positions.rotary_tables.__wrapped__

    def again(tokens: Tensor, tables: positions.RotaryTables, tokens_per_step: int, *how: Any) -> Any:
        conditioning = 2
        grid = round((tokens_per_step - conditioning) ** 0.5)
        layout = positions.TokenLayout(tokens.shape[1] // tokens_per_step, grid, conditioning)
        head_dim = tables.cosine.shape[-1]
        return forward(tokens, uncached(layout, head_dim, tokens.device), tokens_per_step, *how)

    return again


def measure_times(options: argparse.Namespace, frames: int) -> dict[str, list[float]]:
    """Return the seconds of each repeat of each variant; they take turns, after one round that does not count."""
    model = build(options)
    latents, poses = inputs(options, model, frames)
    times: dict[str, list[float]] = {variant: [] for variant in VARIANTS}
    for repeat in range(options.repeats + 1):
        for variant in VARIANTS:
            with computing(model, variant, options.attention):
                start = time.perf_counter()
                step(model, latents, poses, options.dtype)
                if repeat:
                    times[variant].append(time.perf_counter() - start)
    return times


def measure_memory(options: argparse.Namespace) -> float:
    """Return the peak in GB of one step of one variant, weights included."""
    model = build(options)
    latents, poses = inputs(options, model, options.frames[0])
    with computing(model, options.memory_of, options.attention):
        step(model, latents, poses, options.dtype)
    if options.device == "cpu":
        status = Path("/proc/self/status").read_text()
        return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) * 1024 / 1e9
    return torch.cuda.max_memory_allocated() / 1e9


def peak_in_own_process(frames: int, variant: str) -> float:
    """Run one step in a fresh process and return its peak memory in GB."""
    arguments = [*sys.argv[1:], "--frames", str(frames), "--memory-of", variant]
    done = subprocess.run([sys.executable, __file__, *arguments], check=True, capture_output=True, text=True)  # noqa: S603
    return float(json.loads(done.stdout.splitlines()[-1]))


def device_name(device: str) -> str:
    """Return what computes."""
    if device != "cpu":
        return torch.cuda.get_device_name()
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "CPU")


if __name__ == "__main__":
    main()
