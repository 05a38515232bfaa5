"""What is one optimizer step? Micro-batches in, gradients accumulated and clipped, weights moved, or a refusal."""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch

from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import is_url
from vjepa2_ac.training.assembly import Run, encode
from vjepa2_ac.training.optim import learning_rate_at, set_learning_rate, trained_parameters


@dataclass(frozen=True)
class Gradients:
    """What the gradients of one optimizer step were taken from."""

    forced_loss: float  # mean over the clips; NaN where there is none
    rollout_loss: float
    norm: float  # before clipping
    clips: int  # that could be read
    bytes_fetched: int


def training_step(run: Run, batches: Iterator[Batch], step: int) -> dict[str, float]:
    """Do one optimizer step: accumulate gradients over micro-batches, clip, update.

    Raises:
        InputError: The loss or a gradient is not finite; names the clips. The weights have not moved.
    """
    torch.manual_seed(step_seed(run.config.seed, step, run.accelerator.process_index))
    learning_rate = learning_rate_at(step, run.config.training)
    set_learning_rate(run.optimizer, learning_rate)
    taken = gradients(run, batches)
    run.optimizer.step()  # without a clip there are no gradients, and nothing moves
    run.optimizer.zero_grad(set_to_none=True)
    return {
        "loss": taken.forced_loss + taken.rollout_loss,
        "loss_teacher_forcing": taken.forced_loss,
        "loss_rollout": taken.rollout_loss,
        "grad_norm": taken.norm,
        "learning_rate": learning_rate,
        **_about_the_data(run, taken),
    }


def gradients(run: Run, batches: Iterator[Batch]) -> Gradients:
    """Accumulate and clip the gradients of the next micro-batches; the weights do not move.

    Loss and gradient are means over the clips of the step. Where clips are left out (`data.broken_episodes`: skip) they
    are means over those that are left: each counts as much as the others, whatever micro-batch it is in.

    Raises:
        InputError: A loss or gradient is not finite; names the clips.
    """
    training = run.config.training
    run.world_model.train()
    sums = torch.zeros(2, device=run.accelerator.device)
    seen: list[str] = []
    fetched = 0
    for micro in range(training.accumulation):
        batch = next(batches)
        fetched += batch.bytes_fetched
        if not batch.starts:
            continue
        seen += [f"{name} from step {start}" for name, start in zip(batch.episode_ids, batch.starts, strict=True)]
        parts = training.accumulation * (training.batch_size / len(batch.starts))
        last = micro == training.accumulation - 1
        with contextlib.nullcontext() if last else run.accelerator.no_sync(run.objective):
            forced, rollout = run.objective(encode(run, batch))
            run.accelerator.backward((forced + rollout) / parts)
        sums += torch.stack([forced.detach(), rollout.detach()]) / parts
    if not seen:
        return Gradients(math.nan, math.nan, 0.0, clips=0, bytes_fetched=fetched)
    _scale_up(run, sums, training.accumulation * training.batch_size / len(seen))
    grad_norm = _clip(run)
    forced_loss, rollout_loss = sums.tolist()
    _refuse_not_finite(forced_loss + rollout_loss + grad_norm, seen)
    return Gradients(forced_loss, rollout_loss, grad_norm, len(seen), fetched)


def _scale_up(run: Run, sums: torch.Tensor, factor: float) -> None:
    """Turn shares of the clips that were to come into shares of those that came."""
    if factor == 1:
        return
    sums *= factor
    for parameter in trained_parameters(run.objective):
        if parameter.grad is not None:
            parameter.grad *= factor


def _about_the_data(run: Run, taken: Gradients) -> dict[str, float]:
    data, training = run.config.data, run.config.training
    figures: dict[str, float] = {}
    if data.broken_episodes == "skip":
        figures["clips_left_out"] = float(training.accumulation * training.batch_size - taken.clips)
    if is_url(data.path):
        figures["bytes_per_clip"] = taken.bytes_fetched / max(1, taken.clips)
    return figures


def step_seed(seed: int, step: int, rank: int) -> int:
    """Return the seed of a step's random numbers (dropout): no generator state needs to be saved."""
    digest = hashlib.blake2b(f"{seed}/{step}/{rank}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") >> 1


def _clip(run: Run) -> float:
    limit = run.config.training.max_grad_norm
    norm = run.accelerator.clip_grad_norm_(
        list(trained_parameters(run.objective)), math.inf if limit is None else limit
    )
    return float(norm)


def _refuse_not_finite(value: float, clips: list[str]) -> None:
    if math.isfinite(value):
        return
    raise InputError(
        where="training",
        found=f"a loss or gradient that is not finite; the clips were {'; '.join(clips)}",
        fix="The weights have not moved. Look at these clips, or lower training.learning_rate",
    )
