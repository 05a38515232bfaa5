r"""Does a faster way learn the same? Loss curves of two ways on top of each other, and bfloat16 against float32.

    python benchmarks/numerics.py                # per_step against dense: 200 steps, a tiny model
    python benchmarks/numerics.py --compile      # compiled blocks against plain ones, as well
    python benchmarks/numerics.py --device cuda --ways per_step flex --compile --layers 24 --width 1024 \
        --latent-dim 1408 --image-size 256 --frames 16

Each way trains from the same weights on the same clips in the same order, in float32 without dropout. Printed is how
far its loss strays from the plain way's (dense, not compiled), relative, at worst. AdamW makes much of rounding once
gradients are small: beside it stands how far the plain way strays from itself when its first weights are off by 1e-7.
Then 16 predictions are fed back in bfloat16 (weights and autocast) and in float32 from the same weights: the mean
difference of the last, over the mean of the float32 one. It ends with an error where a tolerance is exceeded, or
something fails; the other figures are measured all the same. --json is written after each of them.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from memory import let_go
from random_models import no_fingerprints, random_model
from rows import Rows
from timing import about, add_basics, introduction, prepare, settle
from train_step_variants import our_ways, take_way

from vjepa2_ac.config import AdapterConfig, EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.adapter.lora import add_adapter
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.training.loss import prediction_losses

# Tolerances: of losses in the first quarter, of all of them over what 1e-7 of the weights does, of bfloat16.
EARLY, OF_NOISE, ROLLOUT = 1e-4, 3.0, 0.05
PLAIN = "dense"
QUICK = {"steps": 8}
_NOISE = 1e-7  # of the weights, relative
_ROLLOUT_STEPS, _KNOWN_CLIPS, _LEARNING_RATE = 16, 8, 1e-4


class Curve(NamedTuple):
    """What the plain way learns, and how far it strays from itself."""

    losses: list[float]
    noise: float


def main(arguments: Sequence[str] | None = None) -> None:
    """Print both figures for each way; exit with an error where one is beyond its tolerance, or fails."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(given)
    prepare(options)
    print(introduction(options))
    rows = Rows(options.json, **about(options, given))
    clips = draw(options)
    plain = rows.attempt(partial(plain_curve, options, clips, rows), way=PLAIN)
    beyond = []
    if plain is not None:
        for way in our_ways(options.ways, compiled=options.compile):
            beyond.append(rows.attempt(partial(learns_otherwise, options, clips, way, plain, rows), way=way))
            let_go(options.device)
    beyond.append(rows.attempt(partial(rounds_too_much, options, rows), way="bfloat16"))
    if any(beyond):
        sys.exit("beyond its tolerance")
    rows.finish()


def plain_curve(options: argparse.Namespace, clips: Sequence[LatentBatch], rows: Rows) -> Curve:
    """Return what the plain way learns, and add it as a row."""
    losses = curve(options, clips, PLAIN)
    noise = strays(losses, curve(options, clips, PLAIN, noise=_NOISE))
    rows.add({"way": PLAIN, "losses": losses, "strays": noise})
    print(f"{PLAIN}: loss {losses[0]:.5f} at first, {losses[-1]:.5f} after {len(losses)} steps")
    print(f"{PLAIN} from weights that are off by {_NOISE:g}: strays by {noise:.1e}", flush=True)
    return Curve(losses, noise)


def learns_otherwise(
    options: argparse.Namespace, clips: Sequence[LatentBatch], way: str, plain: Curve, rows: Rows
) -> bool:
    """Return whether a way learns otherwise than the plain one, and add how far it strays as a row."""
    losses, early = curve(options, clips, way), max(1, len(plain.losses) // 4)
    first, worst = strays(plain.losses[:early], losses[:early]), strays(plain.losses, losses)
    beyond = not first <= EARLY or not worst <= EARLY + OF_NOISE * plain.noise
    told = f"strays by {first:.1e} in {early} steps, {worst:.1e} in all (tolerance {EARLY:g}, 3 x noise)"
    print(f"{way}: {told}", flush=True)
    rows.add({"way": way, "losses": losses, "strays_early": first, "strays": worst, "beyond": beyond})
    return beyond


def rounds_too_much(options: argparse.Namespace, rows: Rows) -> bool:
    """Return whether bfloat16 is too far from float32, and add how far it is as a row."""
    error = bfloat16_error(options)
    beyond = not error <= ROLLOUT
    print(f"bfloat16: {error:.2e} after {_ROLLOUT_STEPS} predictions (tolerance {ROLLOUT:g})", flush=True)
    rows.add({"way": "bfloat16", "error": error, "beyond": beyond})
    return beyond


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ways", nargs="+", default=["per_step"], help="attention: per_step, flex, auto")
    parser.add_argument("--compile", action="store_true", help="each way once more with compiled blocks")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--layers", type=int, default=2)
    parser.add_argument("--width", type=int, default=64, help="of the predictor, 32 a head (64 from 512 on)")
    parser.add_argument("--latent-dim", type=int, default=32)
    parser.add_argument("--image-size", type=int, default=32)
    parser.add_argument("--frames", type=int, default=5)
    add_basics(parser)
    return settle(parser.parse_args(arguments), QUICK)


def build(options: argparse.Namespace) -> WorldModel:
    """Return the same model whenever it is asked for; its encoder is never used."""
    heads = options.width // (64 if options.width >= 512 else 32)
    sizes = ModelSizes(
        image_size=options.image_size,
        encoder=EncoderSizes(width=options.latent_dim, heads=2, depth=1),
        predictor=PredictorSizes(width=options.width, heads=heads, depth=options.layers),
    )
    return random_model(sizes, torch.float32, options.device)


def draw(options: argparse.Namespace) -> list[LatentBatch]:
    """Return clips to learn by heart, normalised as latents are."""
    generator = torch.Generator().manual_seed(0)
    tokens = (options.image_size // 16) ** 2
    batches = []
    for _ in range(_KNOWN_CLIPS):
        latents = torch.randn(1, options.frames, tokens, options.latent_dim, generator=generator)
        latents = torch.nn.functional.layer_norm(latents, latents.shape[-1:])
        poses = torch.randn(1, options.frames, 7, generator=generator)
        latents, poses = latents.to(options.device), poses.to(options.device)
        batches.append(LatentBatch(latents, poses, poses[:, 1:] - poses[:, :-1], None, ("a",), (0,)))
    return batches


def curve(options: argparse.Namespace, clips: Sequence[LatentBatch], way: str, noise: float = 0.0) -> list[float]:
    """Return the losses of a training with a kind of attention, compiled where its name says so."""
    model = build(options)
    for parameter in model.parameters() if noise else ():
        parameter.data *= 1 + noise * torch.randn_like(parameter)
    with no_fingerprints():
        add_adapter(model, AdapterConfig(dropout=0.0), seed=0)
    take_way(model, way)
    model.train()
    trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=_LEARNING_RATE)
    losses = []
    for step in range(options.steps):
        forced, rollout = prediction_losses(model, clips[step % len(clips)], rollout_steps=2)
        loss = forced + rollout
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(loss.item())
    return losses


def strays(plain: Sequence[float], other: Sequence[float]) -> float:
    """Return the largest relative difference of two curves at the same step; infinity where a loss is no number."""
    gaps = [abs(one - expected) / expected for one, expected in zip(other, plain, strict=True)]
    return max(gaps) if all(map(math.isfinite, gaps)) else math.inf


@torch.no_grad()
def bfloat16_error(options: argparse.Namespace) -> float:
    """Return how far the last of a row of predictions in bfloat16 is from the float32 one, relative."""
    generator = torch.Generator().manual_seed(1)
    model = build(options).to(torch.bfloat16).eval()
    first = torch.randn(2, 1, model.num_tokens, model.latent_dim, generator=generator)
    first = torch.nn.functional.layer_norm(first, first.shape[-1:])
    poses = torch.randn(2, _ROLLOUT_STEPS, 7, generator=generator) * 0.3
    first, poses = first.to(options.device), poses.to(options.device)
    with torch.autocast(options.device, torch.bfloat16):
        rounded = model.rollout(first, poses, poses)[:, -1]
    exact = model.float().rollout(first, poses, poses)[:, -1]  # of the same weights
    return float((rounded - exact).abs().mean() / exact.abs().mean())


if __name__ == "__main__":
    main()
