"""The optimizer step: gradients of micro-batches accumulated and clipped, weights updated, or the step refused.

Clips whose loss or gradient is not finite are saved for inspection in RUN/not_finite/step-XXXXXXXX. Each process saves
its own: an npz per clip (frames, or the latents of a cache as float32; states, actions, episode_id, start), and its
frames side by side as a PNG.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from vjepa2_ac.data.loader import prefetch_next
from vjepa2_ac.data.sources.latents.cache_files import unpack_latents
from vjepa2_ac.distributed import all_gather_object, all_reduce_gradients, all_reduce_sum, raise_first
from vjepa2_ac.episode import Batch, StoredLatents
from vjepa2_ac.errors import InputError, UserError
from vjepa2_ac.runs.checkpoint import checkpoint_name
from vjepa2_ac.runs.folder import NOT_FINITE
from vjepa2_ac.storage import atomic_writer, is_url, write_atomically
from vjepa2_ac.training.monitoring import Update
from vjepa2_ac.training.optim import learning_rate_at
from vjepa2_ac.training.setup import Run, encode

SMALLEST_LOSS_SCALE = 1.0  # fp16: if gradients still overflow, they are not finite for another reason
MOST_CLIPS = 16  # that are saved
MOST_BYTES = 512 * 10**6  # of frames, held until the gradients are known to be finite


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
    for group in run.optimizer.param_groups:
        group["lr"] = learning_rate
    taken = gradients(run, batches, ClipRecorder(), more=step < run.config.training.steps)
    update = Update(run.trained) if measure_update else None
    if taken.clips:  # without a clip there are no gradients, and nothing moves
        run.scaler.step(run.optimizer)  # with fp16 and an overflow nothing moves either
        run.scaler.update()
    run.optimizer.zero_grad(set_to_none=True)
    metrics = {
        "loss": taken.forced_loss + taken.rollout_loss,
        "loss_teacher_forcing": taken.forced_loss,
        "loss_rollout": taken.rollout_loss,
        "grad_norm": taken.norm,
        "learning_rate": learning_rate,
    }
    if update is not None:
        metrics["update_to_weight"] = update.to_weight()
    if any(data.broken_episodes == "skip" for data in run.config.data_sets):
        metrics["clips_left_out"] = float(run.clips_per_step - taken.clips)
    if any(is_url(data.path) for data in run.config.data_sets):
        metrics["bytes_per_clip"] = taken.bytes_fetched / max(1, taken.clips)
    if run.scaler.is_enabled():
        metrics["loss_scale"] = run.scaler.get_scale()
    return metrics


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
        InputError: A loss or gradient is not finite; names the clips of this process. Or a clip of any process cannot
            be read, or too many episodes of all processes are broken: in all processes.
    """
    if not run.world_model.training:  # after a validation
        run.world_model.train()
    totals, names, fetched, error = torch.zeros(2), list[str](), 0, None
    try:
        with run.cast_matrices.current():
            totals, names, fetched = _accumulate(run, batches, look_back)
        if more:
            prefetch_next(batches)
    except UserError as own:
        error = own
    own_part = [*totals.tolist(), len(names), fetched, error is not None]  # waits for the device
    *losses, clips, bytes_fetched, failed = all_reduce_sum(run.accelerator, own_part)
    if failed:
        raise_first(run.accelerator, error)
    expected = run.clips_per_step
    if clips < expected:
        _tell_of_broken_episodes(run)
    if not clips:
        return Gradients(math.nan, math.nan, 0.0, clips=0, bytes_fetched=int(bytes_fetched))
    forced_loss, rollout_loss = (loss * (expected / clips) for loss in losses)
    norm = _finish_gradients(run, factor=expected / clips)
    _refuse_not_finite(run, forced_loss + rollout_loss, norm, names, look_back)
    return Gradients(forced_loss, rollout_loss, norm, int(clips), int(bytes_fetched))


def _accumulate(
    run: Run, batches: Iterator[Batch], look_back: ClipRecorder | None
) -> tuple[Float[Tensor, 2], list[str], int]:
    """Return this process's part of both losses, the names of its clips, and the bytes fetched for them."""
    totals, names, fetched = torch.zeros(2, device=run.accelerator.device), list[str](), 0
    for _ in run.share.own:
        batch = next(batches)
        fetched += batch.bytes_fetched
        if not batch.starts:
            continue
        names += [f"{name} from step {start}" for name, start in zip(batch.episode_ids, batch.starts, strict=True)]
        parts = run.clips_per_step / len(batch.starts)
        losses = run.micro_step(encode(run, batch), parts)
        totals += losses / parts
        if look_back is not None:
            look_back.add(batch, losses.sum())
    return totals, names, fetched


def _tell_of_broken_episodes(run: Run) -> None:
    """Let each process count the broken episodes of all of them: the allowed share is that of the run.

    Raises:
        InputError: There are too many; in all processes.
    """
    for dataset in run.datasets:
        for reasons in all_gather_object(run.accelerator, dataset.broken.reasons):
            for name, reason in reasons.items():
                dataset.broken.met(name, reason)


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
    return float(norm)


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
    found = f"a loss or gradient that is not finite; the clips were {'; '.join(clips)}"
    fix = f"The weights have not moved. Look at these clips{saved}, or lower training.learning_rate{fp16}"
    raise InputError(where="training", found=found, fix=fix)


class ClipRecorder:
    """The micro-batches of a step, until it is known whether its gradients are finite."""

    def __init__(self) -> None:
        self._kept: list[tuple[Batch, Tensor]] = []
        self._bytes = 0

    def add(self, batch: Batch, loss: Float[Tensor, ""]) -> None:
        """Store a micro-batch and its loss, unless too much is stored already. Does not wait for the loss."""
        self._bytes += batch.nbytes
        if self._bytes <= MOST_BYTES:
            self._kept.append((batch, loss.detach()))

    def save(self, folder: Path, process: int) -> str:
        """Write some clips, those with numbers that are not finite first; return where they are, or what failed.

        Nothing is raised: the error that is being reported is more important.

        Args:
            folder: RUN/not_finite/step-XXXXXXXX.
            process: The process of the clips.
        """
        clips = [(batch, row, loss) for batch, loss in self._kept for row in range(len(batch.starts))]
        clips.sort(key=lambda clip: (_is_finite(*clip[:2]), bool(torch.isfinite(clip[2]))))
        from vjepa2_ac.media.images import encode_png

        try:
            for number, (batch, row, _) in enumerate(clips[:MOST_CLIPS]):
                path = folder / f"process{process}-clip{number:02d}.npz"
                with atomic_writer(path) as file:
                    np.savez_compressed(file, **_arrays(batch, row))
                if batch.frames is not None:
                    strip = np.concatenate(batch.frames[row].numpy(), axis=1)
                    write_atomically(path.with_suffix(".png"), encode_png(strip))
        except Exception as error:  # a full disk, no permission
            return f"they could not all be saved in {folder}: {type(error).__name__}: {error}"
        return f"{min(len(clips), MOST_CLIPS)} of them are saved in {folder}"


def _is_finite(batch: Batch, row: int) -> bool:
    return bool(batch.states[row].isfinite().all() and batch.actions[row].isfinite().all())


def _arrays(batch: Batch, row: int) -> dict[str, Any]:
    arrays: dict[str, Any] = {
        "states": batch.states[row].numpy(),
        "actions": batch.actions[row].numpy(),
        "episode_id": np.array(batch.episode_ids[row]),
        "start": np.array(batch.starts[row]),
    }
    if batch.frames is not None:
        return {"frames": batch.frames[row].numpy(), **arrays}
    if batch.latents is None:
        raise ValueError("a batch with neither frames nor latents")
    scales = None if batch.latents.scales is None else batch.latents.scales[row]
    return {"latents": unpack_latents(StoredLatents(batch.latents.values[row], scales)).numpy(), **arrays}
