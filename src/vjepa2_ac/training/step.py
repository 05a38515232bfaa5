"""The parts of a run, and one optimizer step: losses, gradients over micro-batches and processes, clipping, update."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import smooth_l1_loss

from vjepa2_ac.config import Config, TrainingConfig
from vjepa2_ac.config.section import Positive, Section
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import Batches, MixedDataset, ProcessShare, training_loader
from vjepa2_ac.distributed import PRECISIONS, all_gather_object, all_reduce, all_reduce_gradients, raise_first_error
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.errors import InputError, UserError
from vjepa2_ac.model.distances import absolute_difference
from vjepa2_ac.model.low_rank import CastMatrices
from vjepa2_ac.model.predictor import KeyValueCache, LatentDynamics
from vjepa2_ac.model.world_model import WorldModel, derive_seed
from vjepa2_ac.registry import LOSSES
from vjepa2_ac.runs.checkpoint import RunState
from vjepa2_ac.training.optim import learning_rate_at, trained_parameters

Distance = Callable[[Tensor, Tensor], Tensor]  # (predicted latents, true latents) -> the loss of each element

SMALLEST_LOSS_SCALE = 1.0  # fp16: gradients that are not finite at a smaller scale are an error, not an overflow


@dataclass
class Run:
    """All parts of a run, assembled and checked by `setup.set_up`."""

    config: Config  # `data.stride` is a number here, never auto
    accelerator: Accelerator  # device, precision, and the rank of this process
    world_model: WorldModel
    objective: Callable[[LatentBatch], tuple[Tensor, Tensor]]  # (teacher forcing, rollout)
    micro_step: Callable[[Run, LatentBatch, float], Tensor]  # the function `micro_step`, or a `GraphedMicroStep`
    optimizer: torch.optim.Optimizer
    scaler: torch.amp.GradScaler  # only active with fp16
    dataset: Dataset
    state: RunState
    micro_batches: int  # number per optimizer step, summed over all processes
    calibration: Mapping[str, Any] | None = None  # how the stride was chosen; None unless data.stride was auto
    replay_dataset: Dataset | None = None
    image_strip: Any = None  # decoding.imagine.ValidationStrip, if `validation.decoder` is set

    @property
    def folder(self) -> Path:
        """The path of the run folder."""
        return Path(self.config.run_dir)

    @property
    def datasets(self) -> list[Dataset]:
        """The data set and, if configured, the replay data set."""
        return [self.dataset] if self.replay_dataset is None else [self.dataset, self.replay_dataset]

    @cached_property
    def trained(self) -> list[nn.Parameter]:
        """The trained parameters."""
        return list(trained_parameters(self.world_model))

    @cached_property
    def cast_matrices(self) -> CastMatrices:
        """Copies of the adapter's matrices in the data type of the computation."""
        return CastMatrices(self.world_model.predictor, PRECISIONS[self.config.training.precision])

    @property
    def clips_per_step(self) -> int:
        """The number of clips per optimizer step, summed over all processes."""
        return self.micro_batches * self.config.training.batch_size

    @property
    def share(self) -> ProcessShare:
        """The micro-batches of a step that this process computes."""
        return ProcessShare(self.accelerator.process_index, self.accelerator.num_processes, self.micro_batches)


def iterate_batches(run: Run) -> Batches:
    """Return an iterator over the micro-batches of this process, starting at the current step."""
    replay = run.config.replay
    return training_loader(
        MixedDataset(run.dataset, run.replay_dataset, replay.share if replay else 0.0),
        seed=run.config.seed,
        batch_size=run.config.training.batch_size,
        start_position=run.state.clips_done,
        share=run.share,
        pinned=run.accelerator.device.type == "cuda",
    )


@dataclass(frozen=True)
class Gradients:
    """The gradients of one optimizer step, over all processes."""

    forced_loss: float  # mean over the clips; NaN without clips
    rollout_loss: float
    norm: float  # before clipping; not finite after an overflow in fp16, which the loss scale handles
    clips: int  # number of clips that could be read


def training_step(run: Run, batches: Iterator[Batch], step: int, *, measure_update: bool = False) -> dict[str, float]:
    """Run one optimizer step: accumulate gradients over micro-batches and processes, clip them, update the weights.

    Args:
        run: The run.
        batches: Source of micro-batches.
        step: Number of the step, from 1.
        measure_update: Also return the size of the update, which needs a copy of the weights.

    Raises:
        InputError: The loss or a gradient is not finite; names the clips. The weights are unchanged.
    """
    # Dropout is seeded by the number of the step, so that no generator state needs to be saved.
    torch.manual_seed(derive_seed(run.config.seed, step, run.accelerator.process_index))
    learning_rate = learning_rate_at(step, run.config.training)
    for group in run.optimizer.param_groups:
        group["lr"] = learning_rate
    computed = compute_gradients(run, batches)
    update = Update(run.trained) if measure_update else None
    if computed.clips:  # without a clip there are no gradients, and the weights stay unchanged
        run.scaler.step(run.optimizer)  # skips the update after an overflow in fp16
        run.scaler.update()
    run.optimizer.zero_grad(set_to_none=True)
    metrics = {
        "loss": computed.forced_loss + computed.rollout_loss,
        "loss_teacher_forcing": computed.forced_loss,
        "loss_rollout": computed.rollout_loss,
        "grad_norm": computed.norm,
        "learning_rate": learning_rate,
    }
    if update is not None:
        metrics["update_to_weight"] = update.relative_norm()
    if any(data.broken_episodes == "skip" for data in run.config.data_sets):
        metrics["clips_left_out"] = float(run.clips_per_step - computed.clips)
    if run.scaler.is_enabled():
        metrics["loss_scale"] = run.scaler.get_scale()
    return metrics


def compute_gradients(run: Run, batches: Iterator[Batch]) -> Gradients:
    """Accumulate and clip the gradients of the next micro-batches of all processes; the weights are unchanged.

    Loss and gradient are means over the clips of the step. If clips are skipped (`data.broken_episodes=skip`), they
    are means over the remaining clips. All clips have the same weight, even if micro-batches differ in size.

    Args:
        run: The run.
        batches: Source of micro-batches.

    Raises:
        InputError: A loss or gradient is not finite (the message names the clips of this process), a process cannot
            read a clip, or all processes together have too many broken episodes. In the last two cases all processes
            raise an error.
    """
    if not run.world_model.training:  # after a validation
        run.world_model.train()
    totals, names, error = torch.zeros(2), list[str](), None
    try:
        with run.cast_matrices.use():
            totals, names = _accumulate(run, batches)
    except UserError as raised:
        error = raised
    sums = [*totals.tolist(), len(names), error is not None]  # `tolist` synchronizes with the device
    *losses, num_clips, num_failed = all_reduce(run.accelerator, sums, "sum")
    if num_failed:
        raise_first_error(run.accelerator, error)
    expected = run.clips_per_step
    if num_clips < expected:
        _exchange_broken_episodes(run)
    if not num_clips:
        return Gradients(math.nan, math.nan, 0.0, clips=0)
    forced_loss, rollout_loss = (loss * (expected / num_clips) for loss in losses)
    norm = _finish_gradients(run, factor=expected / num_clips)
    _require_finite(run, forced_loss + rollout_loss, norm, names)
    return Gradients(forced_loss, rollout_loss, norm, int(num_clips))


def _accumulate(run: Run, batches: Iterator[Batch]) -> tuple[Float[Tensor, 2], list[str]]:
    """Add the gradients of this process's micro-batches; return their share of both losses, and the clips' names."""
    totals, names = torch.zeros(2, device=run.accelerator.device), list[str]()
    for _ in run.share.micro_batches:
        batch = next(batches)
        if not batch.starts:
            continue
        names += [f"{name} from step {start}" for name, start in zip(batch.episode_ids, batch.starts, strict=True)]
        loss_divisor = run.clips_per_step / len(batch.starts)
        losses = run.micro_step(run, encode(run, batch), loss_divisor)
        totals += losses / loss_divisor
    return totals, names


def encode(run: Run, batch: Batch) -> LatentBatch:
    """Return the latents of a batch on the run's device, in its precision."""
    with run.accelerator.autocast():
        return encode_batch(run.world_model, batch, device=run.accelerator.device)


def micro_step(run: Run, latents: LatentBatch, loss_divisor: float) -> Float[Tensor, 2]:
    """Add the gradient of (loss / `loss_divisor`); return (teacher forcing, rollout), each a mean over these clips."""
    with run.accelerator.autocast():
        forced, rollout = run.objective(latents)
    run.scaler.scale((forced + rollout) / loss_divisor).backward()  # type: ignore[no-untyped-call]  # torch
    return torch.stack([forced.detach(), rollout.detach()])


class Objective:
    """The loss of a world model on latents: `prediction_losses` with the `training` options of the config."""

    def __init__(self, world_model: LatentDynamics, training: TrainingConfig) -> None:
        self.world_model, self.rollout_steps = world_model, training.rollout_steps
        self.distance: Distance = LOSSES.create(training.loss.name, training.loss.options)

    def __call__(self, batch: LatentBatch) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Return (teacher forcing, rollout); the loss is their sum."""
        return prediction_losses(self.world_model, batch, self.rollout_steps, self.distance)


def prediction_losses(
    world_model: LatentDynamics, batch: LatentBatch, rollout_steps: int, distance: Distance = absolute_difference
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return the losses (teacher forcing, rollout) for one batch, each a mean over all elements.

    Teacher forcing predicts frames 2..T from the true frames 1..T-1. The rollout starts at frame 1: its first
    prediction is that of teacher forcing, and each further prediction is made from the predictions before it. States
    and actions are always the true ones. The rollout reuses the keys and values that teacher forcing computed for the
    first step; losses and gradients are the same as without reuse. With dropout both losses share the masks of the
    first step, which leaves their expectations unchanged.

    Raises:
        ValueError: The rollout is longer than the clip.

    Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/train.py, forward_predictions and loss_fn.
    """
    latents, actions, states, extrinsics = batch.latents, batch.actions, batch.states, batch.extrinsics
    if rollout_steps >= latents.shape[1]:
        raise ValueError(f"a rollout of {rollout_steps} steps needs {rollout_steps + 1} frames, got {latents.shape[1]}")
    states = states[:, :-1]
    extrinsics = None if extrinsics is None else extrinsics[:, :-1]
    cache = KeyValueCache() if rollout_steps > 1 else None
    forced = world_model.predict(latents[:, :-1], actions, states, extrinsics, cache, keep=1)
    rolled = forced[:, :1]
    if rollout_steps > 1:
        rest = slice(1, rollout_steps)
        camera = None if extrinsics is None else extrinsics[:, rest]
        further = world_model.rollout(rolled, actions[:, rest], states[:, rest], camera, cache)
        rolled = torch.cat([rolled, further], dim=1)
    return distance(forced, latents[:, 1:]).mean(), distance(rolled, latents[:, 1 : rollout_steps + 1]).mean()


class SmoothL1:
    """The loss d**2 / (2 * beta) of a difference d below beta, and d - beta / 2 above."""

    class Config(Section):
        """Options of the loss smooth_l1."""

        beta: Positive = 1.0
        """The difference below which the loss is squared."""

    def __init__(self, options: Config) -> None:
        self.beta = options.beta

    def __call__(
        self, predicted: Float[Tensor, "batch time tokens dim"], true: Float[Tensor, "batch time tokens dim"]
    ) -> Float[Tensor, "batch time tokens dim"]:
        """Return the loss of each element, computed in float32."""
        return smooth_l1_loss(predicted.float(), true.float(), reduction="none", beta=self.beta)


def _finish_gradients(run: Run, factor: float) -> float:
    """Sum the gradients of all processes, unscale, multiply by `factor` and clip; return the norm before clipping."""
    all_reduce_gradients(run.accelerator, run.trained)
    run.scaler.unscale_(run.optimizer)
    if factor != 1:
        for parameter in run.trained:
            if parameter.grad is not None:
                parameter.grad *= factor
    limit = run.config.training.max_grad_norm
    return float(nn.utils.clip_grad_norm_(run.trained, math.inf if limit is None else limit))


def _exchange_broken_episodes(run: Run) -> None:
    """Exchange the lists of broken episodes between all processes, because their limit applies to the whole run.

    Raises:
        InputError: There are too many broken episodes; raised in all processes.
    """
    for dataset in run.datasets:
        for reasons in all_gather_object(run.accelerator, dataset.broken.reasons):
            for name, reason in reasons.items():
                dataset.broken.record(name, reason)


def _require_finite(run: Run, loss: float, norm: float, clip_names: list[str]) -> None:
    may_be_overflow = run.scaler.is_enabled() and run.scaler.get_scale() >= SMALLEST_LOSS_SCALE
    if math.isfinite(loss) and (math.isfinite(norm) or may_be_overflow):
        return
    fp16 = ", or set training.precision to bf16 or fp32" if run.scaler.is_enabled() else ""
    problem = f"a loss or gradient that is not finite; the clips were {'; '.join(clip_names)}"
    fix = f"The weights are unchanged. Inspect these clips, or lower training.learning_rate{fp16}"
    raise InputError(where="training", found=problem, fix=fix)


class Update:
    """The size of an optimizer step's update, computed from a copy of the weights before the step.

    Args:
        parameters: The parameters of the optimizer, before the step.
    """

    def __init__(self, parameters: Iterable[Tensor]) -> None:
        self._parameters = list(parameters)
        self._before = [parameter.detach().clone() for parameter in self._parameters]

    def relative_norm(self) -> float:
        """Return norm(update) / norm(weights before the step), over all tensors together. May be called only once."""
        weight_norm = float(torch.nn.utils.get_total_norm(self._before))
        for before, parameter in zip(self._before, self._parameters, strict=True):
            before -= parameter.detach()  # in place, to need no further memory
        return float(torch.nn.utils.get_total_norm(self._before)) / weight_norm if weight_norm else math.nan
