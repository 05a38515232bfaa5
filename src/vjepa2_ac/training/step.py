"""What is one optimizer step? Micro-batches in, gradients accumulated and clipped, weights moved, or a refusal."""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Iterator

import torch

from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError
from vjepa2_ac.training.assembly import Run, encode
from vjepa2_ac.training.optim import learning_rate_at, set_learning_rate, trained_parameters


def training_step(run: Run, batches: Iterator[Batch], step: int) -> dict[str, float]:
    """Do one optimizer step: accumulate gradients over micro-batches, clip, update.

    Raises:
        InputError: The loss or a gradient is not finite; names the clips. The weights have not moved.
    """
    torch.manual_seed(step_seed(run.config.seed, step, run.accelerator.process_index))
    learning_rate = learning_rate_at(step, run.config.training)
    set_learning_rate(run.optimizer, learning_rate)
    forced_loss, rollout_loss, grad_norm = gradients(run, batches)
    run.optimizer.step()
    run.optimizer.zero_grad(set_to_none=True)
    return {
        "loss": forced_loss + rollout_loss,
        "loss_teacher_forcing": forced_loss,
        "loss_rollout": rollout_loss,
        "grad_norm": grad_norm,
        "learning_rate": learning_rate,
    }


def gradients(run: Run, batches: Iterator[Batch]) -> tuple[float, float, float]:
    """Accumulate and clip the gradients of the next micro-batches; the weights do not move.

    Returns:
        Both losses, averaged over the micro-batches, and the norm of the gradients before clipping.

    Raises:
        InputError: A loss or gradient is not finite; names the clips.
    """
    accumulation = run.config.training.accumulation
    run.world_model.train()
    sums = torch.zeros(2, device=run.accelerator.device)
    seen: list[str] = []
    for micro in range(accumulation):
        batch = next(batches)
        seen += [f"{name} from step {start}" for name, start in zip(batch.episode_ids, batch.starts, strict=True)]
        last = micro == accumulation - 1
        with contextlib.nullcontext() if last else run.accelerator.no_sync(run.objective):
            forced, rollout = run.objective(encode(run, batch))
            run.accelerator.backward((forced + rollout) / accumulation)
        sums += torch.stack([forced.detach(), rollout.detach()]) / accumulation
    grad_norm = _clip(run)
    forced_loss, rollout_loss = sums.tolist()
    _refuse_not_finite(forced_loss + rollout_loss + grad_norm, seen)
    return forced_loss, rollout_loss, grad_norm


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
