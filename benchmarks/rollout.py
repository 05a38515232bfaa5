"""How much does a training step gain from reusing keys and values in the rollout? Loss and gradients, LoRA.

    python benchmarks/rollout.py --layers 2 --frames 8 16 --steps 2 6
    python benchmarks/rollout.py --device cuda --dtype bfloat16 --layers 24 --batch 2 --checkpointing

The baseline computes all steps again for each prediction that is fed back, as upstream does. The two take turns, and on
a CPU its own time counts, so that a busy machine disturbs little; a ratio over 1 means faster than the baseline.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from vjepa2_ac.config import AdapterConfig, EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.adapter.lora import add_adapter
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.training.loss import prediction_losses


def main() -> None:
    """Print a line for each number of frames and of rollout steps: milliseconds of both ways, and their ratio."""
    options = parse()
    model = build(options)
    print(f"torch {torch.__version__}, {options.device}, {torch.get_num_threads()} threads, {options.repeats} repeats")
    print(
        f"{options.layers} layers, {options.image_size} px, batch {options.batch}, {options.dtype}"
        f"{', gradient checkpointing' if options.checkpointing else ''}"
    )
    print(f"{'frames':>6} {'rollout':>8} {'again, ms':>10} {'reused, ms':>11} {'ratio':>6}")
    for frames in options.frames:
        batch = clips(options, model, frames)
        for steps in options.steps:
            again, reused = take_turns(
                options, partial(plain_loss, model, batch, steps), partial(loss, model, batch, steps)
            )
            ratio = statistics.median(a / r for a, r in zip(again, reused, strict=True))
            medians = [statistics.median(times) * 1e3 for times in (again, reused)]
            print(f"{frames:>6} {steps:>8} {medians[0]:10.0f} {medians[1]:11.0f} {ratio:6.2f}", flush=True)


def parse() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layers", type=int, default=2)
    parser.add_argument("--frames", type=int, nargs="+", default=[8, 16])
    parser.add_argument("--steps", type=int, nargs="+", default=[2, 6], help="predictions of the rollout")
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--dtype", choices=("float32", "bfloat16"), default="float32")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--checkpointing", action="store_true")
    return parser.parse_args()


def build(options: argparse.Namespace) -> WorldModel:
    """Return a model of the released predictor's width with the default adapter; its encoder is never used."""
    sizes = ModelSizes(
        image_size=options.image_size, encoder=EncoderSizes(depth=1), predictor=PredictorSizes(depth=options.layers)
    )
    model = WorldModel.random(sizes, seed=0, dtype=getattr(torch, options.dtype))
    add_adapter(model, AdapterConfig(), seed=0)
    model.set_gradient_checkpointing(options.checkpointing)
    return model.to(options.device).train()


def clips(options: argparse.Namespace, model: WorldModel, frames: int) -> LatentBatch:
    """Return random clips."""
    generator = torch.Generator().manual_seed(0)
    latents = torch.randn(options.batch, frames, model.num_tokens, model.latent_dim, generator=generator)
    poses = torch.randn(options.batch, frames, 7, generator=generator)
    device, names = options.device, ("a",) * options.batch
    given = (value.to(device) for value in (latents, poses, poses[:, 1:].clone()))
    return LatentBatch(*given, None, names, (0,) * options.batch)


def loss(model: WorldModel, batch: LatentBatch, steps: int) -> Tensor:
    """Return the loss as in training."""
    return prediction_losses(model, batch, steps).total


def plain_loss(model: WorldModel, batch: LatentBatch, steps: int) -> Tensor:
    """Return the same, every prediction from the first frame on."""
    z, actions, states = batch.latents, batch.actions, batch.states[:, :-1]
    forced = model.predict(z[:, :-1], actions, states)
    seen = torch.cat([z[:, :1], forced[:, :1]], dim=1)
    for end in range(2, steps + 1):
        following = model.predict(seen, actions[:, :end], states[:, :end])[:, -1:]
        seen = torch.cat([seen, following], dim=1)
    return (forced - z[:, 1:]).abs().mean() + (seen[:, 1:] - z[:, 1 : steps + 1]).abs().mean()


def take_turns(options: argparse.Namespace, *ways: Callable[[], Tensor]) -> list[list[float]]:
    """Return the seconds of forward and backward of each way; the first round does not count."""
    clock = time.process_time if options.device == "cpu" else time.perf_counter
    times: list[list[float]] = [[] for _ in ways]
    for repeat in range(options.repeats + 1):
        for way, taken in zip(ways, times, strict=True):
            start = clock()
            with torch.autocast(options.device, torch.bfloat16, enabled=options.dtype == "bfloat16"):
                value = way()
            value.backward()
            if options.device != "cpu":
                torch.cuda.synchronize()
            if repeat:
                taken.append(clock() - start)
    return times


if __name__ == "__main__":
    main()
