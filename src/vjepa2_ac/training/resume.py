"""Resuming a run: from its newest checkpoint, on any number of processes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.index import fingerprint_of
from vjepa2_ac.distributed.collectives import broadcast_object, broadcast_tensors, require_same
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter.lora import load_trained
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import (
    ADAPTER,
    OPTIMIZER,
    STATE,
    RunState,
    newest_checkpoint,
    read_state,
    written_state,
)
from vjepa2_ac.runs.folder import CHECKPOINTS, CONFIG, read_run_config, run_id
from vjepa2_ac.runs.torch_file import read_torch
from vjepa2_ac.training.best_checkpoint import best_so_far, measured_on
from vjepa2_ac.training.fsdp import shard_predictor
from vjepa2_ac.training.optim import load_moments
from vjepa2_ac.training.setup import Run


def restore(run: Run, reporter: Reporter) -> Run:
    """Bring a run to its newest checkpoint, in every process, and share its weights where the launch requests it.

    Raises:
        InputError: The processes have different bases, or the checkpoint is not of this run.
    """
    state = _state_of_all(run, reporter)
    run.optimizer = shard_predictor(run.world_model, run.optimizer, run.config, run.accelerator, reporter)
    restore_loss_scale(run.scaler, state)
    run.dataset.broken.recall(state.broken)
    _report_data_changes(run.dataset, state.windows, reporter)
    if run.replayed is not None:
        run.replayed.broken.recall(state.replayed_broken)
        _report_data_changes(run.replayed, state.replayed_windows, reporter)
    run.state = best_so_far(state, measured_on(run.config, run.dataset), reporter)
    run.micro_batches = micro_batches_of(run.config, state, run.accelerator.num_processes, reporter)
    return run


def _state_of_all(run: Run, reporter: Reporter) -> RunState:
    """Restore weights and moments in every process: the first one reads them, and sends them to the others."""
    config, accelerator, world_model = run.config, run.accelerator, run.world_model
    encoder = world_model.adaptation.encoder if world_model.adaptation else ""
    require_same(accelerator, encoder, what="model.base", fix="Give every machine the same checkpoint")
    state, moments = RunState(step=0), None
    if accelerator.is_main_process and (checkpoint := newest_checkpoint(run.folder / CHECKPOINTS)) is not None:
        state, moments = _read(checkpoint, world_model, run.optimizer)
        reporter.note(f"Going on from {checkpoint} ({state.step} of {config.training.steps} steps are done).")
    state = broadcast_object(accelerator, replace(state, run_id=state.run_id or run_id(run.folder)))
    broadcast_tensors(accelerator, world_model.predictor.state_dict().values())
    moments = broadcast_object(accelerator, moments)
    if moments is not None and not accelerator.is_main_process:
        load_moments(run.optimizer, moments)
    return state


def micro_batches_of(config: Config, state: RunState, processes: int, reporter: Reporter) -> int:
    """Return the number of micro-batches of a process per step.

    It is the config's, at the first start and if batch_size * accumulation was changed on purpose; else the number that
    keeps the clips per step, on any number of processes and after any number of restarts.

    Raises:
        InputError: This number of processes cannot share a step's clips evenly.
    """
    batch_size, accumulation = config.training.batch_size, config.training.accumulation
    if state.clips_per_step is None:
        return accumulation
    asked_before = state.clips_asked or state.clips_per_step // state.processes
    if asked_before != batch_size * accumulation or state.clips_per_step == batch_size * accumulation * processes:
        return accumulation
    micro_batches, rest = divmod(state.clips_per_step, batch_size * processes)
    if rest or not micro_batches:
        raise InputError(
            where="training.batch_size",
            found=f"{processes} processes of {batch_size} clips for a run with {state.clips_per_step} clips per step",
            needed="a number of processes and a batch_size whose product divides the clips of a step",
            fix="Start another number of processes; or set training.batch_size and training.accumulation to what each"
            " is to do, with --allow-config-change",
        )
    reporter.note(
        f"{processes} processes, before {state.processes}: {micro_batches} micro-batches of {batch_size} in each, so"
        f" that a step has the same {state.clips_per_step} clips."
    )
    return micro_batches


def restore_loss_scale(scaler: torch.amp.GradScaler, state: RunState) -> None:
    """Restore the loss scale of the checkpoint.

    Raises:
        InputError: The stored value is no loss scale.
    """
    if state.loss_scale is None or not scaler.is_enabled():
        return
    known = scaler.state_dict().keys()
    if state.loss_scale.keys() != known:
        found, needed = f"{STATE} with loss_scale of {sorted(state.loss_scale)}", f"{sorted(known)}"
        raise InputError(
            where="--resume", found=found, needed=needed, fix="Delete this checkpoint, to use an older one"
        )
    scaler.load_state_dict(dict(state.loss_scale))


def require_same_data(config: Config, dataset: Dataset, replayed: Dataset | None = None) -> None:
    """Refuse to go on with other data sets than those that the run in its folder began with.

    At the place where it began the data may have changed, which is reported; elsewhere they must be the same.

    Raises:
        InputError: They are others, or an earlier version did not note which they were.
    """
    folder = Path(config.run_dir)
    before = read_run_config(folder).data_sets if (folder / CONFIG).is_file() else config.data_sets
    keys, datasets = ("data.path", "replay.data.path"), [one for one in (dataset, replayed) if one is not None]
    for number, (key, one, began, now) in enumerate(zip(keys, datasets, before, config.data_sets, strict=False)):
        if began.path == now.path or (checkpoint := newest_checkpoint(folder / CHECKPOINTS)) is None:
            continue
        state = written_state(checkpoint)
        seen = (state.data, state.replayed_data)[number]
        if seen == fingerprint_of(one.table):
            continue
        raise InputError(
            where=f"{key}: {now.path}",
            found="other episodes or files than the run has seen" if seen else "a run that did not note its data",
            needed=f"the data set that was at {began.path}",
            fix=f"Set {key} to where that is now (its files keep names, sizes and times when they are moved); where the"
            " change is meant, add --allow-config-change",
        )


def _report_data_changes(dataset: Dataset, before: int | None, reporter: Reporter) -> None:
    """Report if the data has changed since the checkpoint was written, with so many training clips then."""
    windows = len(dataset.windows("train"))
    if before not in {None, windows}:
        reporter.note(
            f"The data has changed: {windows:,} training clips instead of {before:,}."
            " From here on their order is another, and some may be seen twice in this epoch or not at all."
        )


def _read(
    checkpoint: Path, world_model: WorldModel, optimizer: torch.optim.Optimizer
) -> tuple[RunState, dict[str, Any]]:
    load_trained(world_model, checkpoint / ADAPTER, trainable=True)
    try:
        moments = read_torch(checkpoint / OPTIMIZER)
        load_moments(optimizer, moments)
        return read_state(checkpoint), moments
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise InputError(
            where=str(checkpoint),
            found=f"not the state of this run ({error})",
            fix="Set back what was changed in the config; or delete this checkpoint, to use an older one",
        ) from None
