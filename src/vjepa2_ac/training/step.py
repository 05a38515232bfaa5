"""The optimizer step: gradients of micro-batches accumulated and clipped, weights updated, or the step refused."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor

from vjepa2_ac.data.loader import prefetch_next
from vjepa2_ac.distributed.collectives import all_reduce_gradients, all_reduce_sum
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import checkpoint_name
from vjepa2_ac.runs.folder import NOT_FINITE
from vjepa2_ac.storage import is_url
from vjepa2_ac.training.monitoring.nonfinite_clips import ClipRecorder
from vjepa2_ac.training.monitoring.throughput import Update
from vjepa2_ac.training.optim import learning_rate_at, set_learning_rate
from vjepa2_ac.training.setup import Run, encode

SMALLEST_LOSS_SCALE = 1.0  # fp16: if gradients still overflow, they are not finite for another reason


@dataclass(frozen=True)
class Gradients:
    """The gradients of one optimizer step, over all processes."""

    forced_loss: float  # mean over the clips; NaN where there is none
    rollout_loss: float
    norm: float  # before clipping; not finite after an overflow in fp16, which the loss scale handles
    clips: int  # that were read
    bytes_fetched: int


def training_step(run: Run, batches: Iterator[Batch], step: int, *, measure_update: bool = False) -> dict[str, float]:
    """Do one optimizer step: accumulate gradients over micro-batches and processes, clip, update.

    Args:
        run: The run.
        batches: Source of its micro-batches.
        step: From 1.
        measure_update: Also return how far the weights have moved, which needs a copy of them.

    Raises:
        InputError: The loss or a gradient is not finite; names the clips and saves them. The weights have not moved.
    """
    torch.manual_seed(step_seed(run.config.seed, step, run.accelerator.process_index))
    learning_rate = learning_rate_at(step, run.config.training)
    set_learning_rate(run.optimizer, learning_rate)
    taken = gradients(run, batches, ClipRecorder(), more=step < run.config.training.steps)
    update = Update(run.trained) if measure_update else None
    if taken.clips:  # without a clip there are no gradients, and nothing moves
        run.scaler.step(run.optimizer)  # with fp16 and an overflow nothing moves either
        run.scaler.update()
    run.optimizer.zero_grad(set_to_none=not run.config.training.cuda_graph)  # a graph adds to the same tensors
    return {
        "loss": taken.forced_loss + taken.rollout_loss,
        "loss_teacher_forcing": taken.forced_loss,
        "loss_rollout": taken.rollout_loss,
        "grad_norm": taken.norm,
        "learning_rate": learning_rate,
        **({"update_to_weight": update.to_weight()} if update else {}),
        **_about_the_data(run, taken),
        **({"loss_scale": run.scaler.get_scale()} if run.scaler.is_enabled() else {}),
    }


def gradients(
    run: Run, batches: Iterator[Batch], look_back: ClipRecorder | None = None, *, more: bool = False
) -> Gradients:
    """Accumulate and clip the gradients of the next micro-batches of all processes; the weights do not move.

    Loss and gradient are means over the clips of the step. Where clips are left out (`data.broken_episodes`: skip) they
    are means over those that are left: each counts as much as the others, whatever micro-batch it is in.

    Args:
        run: The run.
        batches: Source of its micro-batches.
        look_back: Saves clips into the run's folder if a loss or gradient is not finite; None: nothing is written.
        more: Whether another step follows, whose first micro-batch is fetched while the device is computing.

    Raises:
        InputError: A loss or gradient is not finite; names the clips of this process.
    """
    if not run.world_model.training:  # after a validation
        run.world_model.train()
    expected = run.clips_per_step
    with run.cast_matrices.current():
        totals, seen, fetched = _accumulate(run, batches, look_back)
    if more:
        prefetch_next(batches)
    *losses, clips, fetched_by_all = all_reduce_sum(run.accelerator, [*totals.tolist(), len(seen), fetched])
    if not clips:
        return Gradients(math.nan, math.nan, 0.0, clips=0, bytes_fetched=int(fetched_by_all))
    forced_loss, rollout_loss = (loss * (expected / clips) for loss in losses)
    norm = _finish_gradients(run, factor=expected / clips)
    _refuse_not_finite(run, forced_loss + rollout_loss, norm, seen, look_back)
    return Gradients(forced_loss, rollout_loss, norm, int(clips), int(fetched_by_all))


def _accumulate(run: Run, batches: Iterator[Batch], look_back: ClipRecorder | None) -> tuple[Tensor, list[str], int]:
    """Return the losses of this process's clips, as parts of the step's; names of the clips; and bytes fetched."""
    totals = torch.zeros(2, device=run.accelerator.device)
    seen: list[str] = []
    fetched = 0
    for _ in range(run.micro_batches):
        batch = next(batches)
        fetched += batch.bytes_fetched
        if not batch.starts:
            continue
        seen += [f"{name} from step {start}" for name, start in zip(batch.episode_ids, batch.starts, strict=True)]
        parts = run.clips_per_step / len(batch.starts)
        losses = run.micro_step(encode(run, batch), parts)
        totals += losses / parts
        if look_back is not None:
            look_back.add(batch, losses.sum())
    return totals, seen, fetched


def _finish_gradients(run: Run, factor: float) -> float:
    """Turn the scaled sums of all processes into the gradient of the mean, clip it, and return its norm before."""
    all_reduce_gradients(run.accelerator, run.trained)
    run.scaler.unscale_(run.optimizer)
    if factor != 1:
        for parameter in run.trained:
            if parameter.grad is not None:
                parameter.grad *= factor
    limit = run.config.training.max_grad_norm
    norm = nn.utils.clip_grad_norm_(run.trained, math.inf if limit is None else limit)
    return float(norm.full_tensor() if isinstance(norm, DTensor) else norm)


def _about_the_data(run: Run, taken: Gradients) -> dict[str, float]:
    metrics: dict[str, float] = {}
    if any(data.broken_episodes == "skip" for data in run.config.data_sets):
        metrics["clips_left_out"] = float(run.clips_per_step - taken.clips)
    if any(is_url(data.path) for data in run.config.data_sets):
        metrics["bytes_per_clip"] = taken.bytes_fetched / max(1, taken.clips)
    return metrics


def step_seed(seed: int, step: int, rank: int) -> int:
    """Return the seed of a step's random numbers (dropout): no generator state needs to be saved."""
    digest = hashlib.blake2b(f"{seed}/{step}/{rank}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") >> 1


def _refuse_not_finite(run: Run, loss: float, norm: float, clips: list[str], look_back: ClipRecorder | None) -> None:
    overflow = run.scaler.is_enabled() and run.scaler.get_scale() >= SMALLEST_LOSS_SCALE
    if math.isfinite(loss) and (math.isfinite(norm) or overflow):
        return
    saved = ""
    if look_back is not None:
        folder = Path(run.config.run_dir) / NOT_FINITE / checkpoint_name(run.state.step + 1)
        saved = f" ({look_back.save(folder, run.accelerator.process_index)})"
    fp16 = ", or set training.precision to bf16 or fp32" if run.scaler.is_enabled() else ""
    raise InputError(
        where="training",
        found=f"a loss or gradient that is not finite; the clips were {'; '.join(clips)}",
        fix=f"The weights have not moved. Look at these clips{saved}, or lower training.learning_rate{fp16}",
    )
