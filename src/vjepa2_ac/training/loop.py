"""The training loop: assembly, one step, and the loop over steps.

What makes a run exact: the clips of a step, its learning rate and its random numbers are pure functions of (config,
step). A run that was killed continues from its newest checkpoint as if nothing had happened.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState

from vjepa2_ac.config import Config
from vjepa2_ac.data.loader import open_source, training_loader, validation_batches
from vjepa2_ac.episode import Batch, EpisodeSource, LatentBatch
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.metrics import PredictionErrors, one_step_ratios, prediction_errors, ratios_by_horizon
from vjepa2_ac.latents import encode_batch
from vjepa2_ac.model.load import load_base
from vjepa2_ac.model.lora import add_adapter, load_trained, save_trained, trainable_report
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training.checkpoint import RunState, newest_checkpoint, read_state, write_checkpoint
from vjepa2_ac.training.journal import Journal
from vjepa2_ac.training.loss import Objective
from vjepa2_ac.training.optim import learning_rate_at, make_optimizer, set_learning_rate, trained_parameters
from vjepa2_ac.training.run_folder import CHECKPOINTS, check_run_folder, open_run_folder

logger = logging.getLogger(__name__)

ADAPTER = "adapter"
OPTIMIZER = "optimizer.pt"


@runtime_checkable
class Reporter(Protocol):
    """Shows a run to a person."""

    def note(self, text: str) -> None:
        """Say something once."""
        ...

    def started(self, done: int, total: int) -> None:
        """The loop begins after `done` of `total` optimizer steps."""
        ...

    def stepped(self, step: int, figures: dict[str, float]) -> None:
        """An optimizer step is done."""
        ...

    def validated(self, step: int, errors: PredictionErrors) -> None:
        """Held-out clips were measured after `step` optimizer steps."""
        ...


@dataclass
class Run:
    """Everything the loop needs, assembled and checked."""

    config: Config
    accelerator: Accelerator
    world_model: WorldModel
    objective: torch.nn.Module
    optimizer: torch.optim.Optimizer
    source: EpisodeSource
    state: RunState


def train(config: Config, reporter: Reporter, *, check_only: bool = False) -> Path:
    """Train as the config says, from the newest checkpoint of its run folder if there is one.

    Args:
        config: The run.
        reporter: Shows progress.
        check_only: Do everything that can fail, and stop before the first step and before anything is written.

    Returns:
        The folder of the run.

    Raises:
        InputError: Something the user gave cannot be used; raised before the first step wherever that can be known.
    """
    check_run_folder(config)
    run = assemble(config, reporter)
    if check_only:
        _refuse_weak_base(config, _validate(run, reporter))
        reporter.note("Everything is in place: one batch was read, encoded and measured. Nothing was written.")
        return Path(config.run_dir)
    folder = open_run_folder(config)
    with Journal(folder, first_step=run.state.step, tensorboard=config.tracking.tensorboard) as journal:
        if run.state.step == 0:
            errors = _validate(run, reporter)
            journal.write("validation", 0, validation_figures(errors))
            _refuse_weak_base(config, errors)
        _loop(run, folder, journal, reporter)
    return folder


def assemble(config: Config, reporter: Reporter) -> Run:
    """Open the data, load the model, attach the adapter, and take up the newest checkpoint. Cheap failures first.

    Raises:
        InputError: Something cannot be used.
    """
    accelerator = make_accelerator(config)
    source = open_source(config.data)
    _read_one_clip_of_each_split(source, config)
    world_model = load_base(config.model, seed=config.seed)
    add_adapter(world_model, config.adapter, seed=config.seed)
    report = trainable_report(world_model)
    reporter.note(
        f"Training {report.trained:,} parameters ({config.adapter.kind}), {report.share:.2%} of the predictor's"
        f" {report.predictor:,}; the whole model has {report.total:,}."
    )
    if config.training.gradient_checkpointing:
        world_model.set_gradient_checkpointing(enabled=True)
    optimizer = make_optimizer(world_model, config.training)
    state = _take_up(config, world_model, optimizer, reporter)
    world_model.to(accelerator.device)
    objective, optimizer = accelerator.prepare(Objective(world_model, config.training.rollout_steps), optimizer)
    return Run(config, accelerator, world_model, objective, optimizer, source, state)


def make_accelerator(config: Config) -> Accelerator:
    """Return the device and precision of a run.

    Raises:
        InputError: CUDA was asked for and there is none.
    """
    if config.training.device == "cuda" and not torch.cuda.is_available():
        raise InputError(
            where="training.device",
            found="cuda, but this PyTorch sees no CUDA device",
            fix="Set training.device=cpu, or install a CUDA build of PyTorch and a driver",
        )
    precision = "bf16" if config.training.precision == "bf16" else "no"
    AcceleratorState._reset_state(reset_partial_state=False)  # or a second run keeps the first's precision
    return Accelerator(mixed_precision=precision, cpu=config.training.device == "cpu")


def _loop(run: Run, folder: Path, journal: Journal, reporter: Reporter) -> None:
    config, training = run.config, run.config.training
    batches = _batches_from(run, run.state.step)
    reporter.started(run.state.step, training.steps)
    for step in range(run.state.step + 1, training.steps + 1):
        started = time.perf_counter()
        figures = training_step(run, batches, step)
        figures["samples_per_second"] = training.batch_size * training.accumulation / (time.perf_counter() - started)
        reporter.stepped(step, figures)
        last = step == training.steps
        if step % training.log_every == 0 or last:
            journal.write("train", step, figures)
        run.state = replace(run.state, step=step)
        if step % config.validation.every == 0 or last:
            errors = _validate(run, reporter)
            journal.write("validation", step, validation_figures(errors))
            run.state = _with_best(run.state, errors)
        if step % config.checkpoint.every == 0 or last:
            write_checkpoint(folder / CHECKPOINTS, run.state, _writer(run), keep=config.checkpoint.keep)


def training_step(run: Run, batches: Iterator[Batch], step: int) -> dict[str, float]:
    """Do one optimizer step: accumulate gradients over micro-batches, clip, update.

    Raises:
        InputError: The loss or a gradient is not finite; names the clips. The weights have not moved.
    """
    training = run.config.training
    torch.manual_seed(step_seed(run.config.seed, step, run.accelerator.process_index))
    learning_rate = learning_rate_at(step, training)
    set_learning_rate(run.optimizer, learning_rate)
    run.world_model.train()
    sums = torch.zeros(2, device=run.accelerator.device)
    seen: list[Batch] = []
    for micro in range(training.accumulation):
        batch = next(batches)
        seen.append(batch)
        latents = _encode(run, batch)
        last = micro == training.accumulation - 1
        with contextlib.nullcontext() if last else run.accelerator.no_sync(run.objective):
            forced, rollout = run.objective(latents)
            run.accelerator.backward((forced + rollout) / training.accumulation)
        sums += torch.stack([forced.detach(), rollout.detach()]) / training.accumulation
    grad_norm = _clip(run)
    forced_loss, rollout_loss = sums.tolist()
    _refuse_not_finite(step, forced_loss + rollout_loss + grad_norm, seen)
    run.optimizer.step()
    run.optimizer.zero_grad(set_to_none=True)
    return {
        "loss": forced_loss + rollout_loss,
        "loss_teacher_forcing": forced_loss,
        "loss_rollout": rollout_loss,
        "grad_norm": grad_norm,
        "learning_rate": learning_rate,
    }


def step_seed(seed: int, step: int, rank: int) -> int:
    """Return the seed of a step's random numbers (dropout): no generator state needs to be saved."""
    digest = hashlib.blake2b(f"{seed}/{step}/{rank}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") >> 1


def validation_figures(errors: PredictionErrors) -> dict[str, Any]:
    """Return what a validation writes into the journal."""
    by_horizon, one_step = ratios_by_horizon(errors), one_step_ratios(errors)
    return {
        "error_over_persistence": one_step["true"].value,
        "error_over_persistence_zero_actions": one_step["zero"].value,
        "error_over_persistence_shuffled_actions": one_step["shuffled"].value,
        "rollout_over_persistence": [r.value for r in by_horizon],
        "rollout_over_persistence_last": by_horizon[-1].value,
    }


def _encode(run: Run, batch: Batch) -> LatentBatch:
    with run.accelerator.autocast():
        return encode_batch(run.world_model, batch, device=run.accelerator.device, chunk=run.config.model.encode_chunk)


def _validate(run: Run, reporter: Reporter) -> PredictionErrors:
    config = run.config
    run.world_model.eval()
    batches = validation_batches(
        run.source,
        config.data,
        split="validation",
        clips=config.validation.clips,
        batch_size=config.validation.batch_size,
    )
    with run.accelerator.autocast():
        errors = prediction_errors(run.world_model, (_encode(run, batch) for batch in batches))
    reporter.validated(run.state.step, errors)
    return errors


def _refuse_weak_base(config: Config, errors: PredictionErrors) -> None:
    error = one_step_ratios(errors)["true"].value
    if error < 1.0 or config.training.allow_weak_base or config.model.random is not None:
        return
    raise InputError(
        where="model.base",
        found=f"on the validation clips its one-step error is {error:.2f} times that of copying the last frame",
        needed="a base that is better than doing nothing (below 1)",
        fix="Check the checkpoint, data.stride, data.camera, the order of the state and the gripper's direction;"
        " to adapt it all the same, set training.allow_weak_base=true",
    )


def _refuse_not_finite(step: int, value: float, seen: list[Batch]) -> None:
    if math.isfinite(value):
        return
    clips = [
        f"{name} from step {start}"
        for batch in seen
        for name, start in zip(batch.episode_ids, batch.starts, strict=True)
    ]
    raise InputError(
        where=f"optimizer step {step}",
        found=f"a loss or gradient that is not finite; the clips were {'; '.join(clips)}",
        fix="The weights have not moved. Look at these clips, or lower training.learning_rate",
    )


def _clip(run: Run) -> float:
    limit = run.config.training.max_grad_norm
    norm = run.accelerator.clip_grad_norm_(
        list(trained_parameters(run.objective)), math.inf if limit is None else limit
    )
    return float(norm)


def _batches_from(run: Run, step: int) -> Iterator[Batch]:
    training = run.config.training
    micro_batches_done = step * training.accumulation
    return training_loader(
        run.source,
        run.config.data,
        seed=run.config.seed,
        batch_size=training.batch_size,
        start_position=micro_batches_done * run.accelerator.num_processes * training.batch_size,
        rank=run.accelerator.process_index,
        world_size=run.accelerator.num_processes,
    )


def _read_one_clip_of_each_split(source: EpisodeSource, config: Config) -> None:
    """Fail early: an empty split, a broken first clip."""
    for split in ("train", "validation"):
        next(validation_batches(source, config.data, split, clips=1, batch_size=1))


def _with_best(state: RunState, errors: PredictionErrors) -> RunState:
    error = one_step_ratios(errors)["true"].value
    if state.best_error is None or error < state.best_error:
        return replace(state, best_step=state.step, best_error=error)
    return state


def _writer(run: Run) -> Any:
    def write(folder: Path) -> None:
        save_trained(run.world_model, folder / ADAPTER)
        torch.save(run.optimizer.state_dict(), folder / OPTIMIZER)

    return write


def _take_up(config: Config, world_model: WorldModel, optimizer: torch.optim.Optimizer, reporter: Reporter) -> RunState:
    checkpoint = newest_checkpoint(Path(config.run_dir) / CHECKPOINTS)
    if checkpoint is None:
        return RunState(step=0)
    load_trained(world_model, checkpoint / ADAPTER, trainable=True)
    optimizer.load_state_dict(torch.load(checkpoint / OPTIMIZER, weights_only=True, map_location="cpu"))
    state = read_state(checkpoint)
    reporter.note(f"Going on from {checkpoint} ({state.step} of {config.training.steps} steps are done).")
    return state
