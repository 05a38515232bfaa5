"""Save and restore checkpoints of a run. Resuming is exact, also with another number of processes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from accelerate.utils import broadcast

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import flatten
from vjepa2_ac.config.section import Affects, values_that_affect
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.index import compute_fingerprint
from vjepa2_ac.data.loader import validation_windows
from vjepa2_ac.distributed import broadcast_object, require_same, run_on_first
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.model.adapter_folder import load_trained, save_trained
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import (
    ADAPTER,
    CHECKPOINTS,
    OPTIMIZER,
    DataState,
    RunState,
    checkpoint_name,
    newest_checkpoint,
    read_state,
    read_torch,
    write_checkpoint,
    write_torch,
)
from vjepa2_ac.runs.folder import read_or_create_run_id
from vjepa2_ac.runs.metrics_log import warn_if_stalled
from vjepa2_ac.training.optim import load_moments
from vjepa2_ac.training.step import Run

_CLIPS_KEY = "its clips"  # key of the hash of the validation clips, in state.json


def save_checkpoint(run: Run, folder: Path) -> None:
    """Save a checkpoint into the run folder (see `runs.checkpoint`). All processes call this; only the first writes.

    Raises:
        InputError: The checkpoint cannot be written; raised in the first process only.
    """

    def write(checkpoint: Path) -> None:
        save_trained(run.world_model, checkpoint / ADAPTER)
        with (checkpoint / OPTIMIZER).open("wb") as file:
            write_torch(run.optimizer.state_dict(), file)

    run.state = replace(
        run.state,
        data=tuple(
            DataState(compute_fingerprint(dataset.table), len(dataset.windows("train")), dataset.broken.reasons)
            for dataset in run.datasets
        ),
        clips_per_step=run.clips_per_step,
        clips_per_process=run.config.training.batch_size * run.config.training.accumulation,
        num_processes=run.accelerator.num_processes,
        loss_scale=run.scaler.state_dict() if run.scaler.is_enabled() else None,
    )
    if run.accelerator.is_main_process:
        with warn_if_stalled(folder / CHECKPOINTS / checkpoint_name(run.state.step)):
            write_checkpoint(folder / CHECKPOINTS, run.state, write, keep=run.config.checkpoint.keep)


def restore(run: Run, reporter: Reporter) -> Run:
    """Restore the newest checkpoint of a run in all processes.

    Raises:
        InputError: The processes have different base models, or the checkpoint does not fit this run.
    """
    state = _restore_in_all_processes(run, reporter)
    if state.loss_scale is not None and run.scaler.is_enabled():
        run.scaler.load_state_dict(dict(state.loss_scale))
    for dataset, before in zip(run.datasets, state.data, strict=False):
        dataset.broken.restore(before.broken)
        if (windows := len(dataset.windows("train"))) != before.windows:
            reporter.note(
                f"The data has changed: {counted(windows, 'training clip')} instead of {before.windows:,}. The order of"
                " the next clips changes, and some clips may occur twice or not at all in this epoch."
            )
    run.state = keep_comparable_best(state, validation_settings(run.config, run.dataset), reporter)
    run.micro_batches = count_micro_batches(run.config, state, run.accelerator.num_processes, reporter)
    return run


def _restore_in_all_processes(run: Run, reporter: Reporter) -> RunState:
    """Restore weights and moments in all processes: the first process reads them and sends them to the others."""
    accelerator, world_model = run.accelerator, run.world_model
    encoder = world_model.adaptation.encoder if world_model.adaptation else ""
    require_same(accelerator, encoder, what="model.base", fix="Give every machine the same checkpoint")
    newest = run_on_first(accelerator, lambda: _read_newest(run, reporter))
    state, moments = broadcast_object(accelerator, newest or (RunState(step=0), None))
    broadcast(list(world_model.predictor.state_dict().values()))  # in place
    if moments is not None and not accelerator.is_main_process:
        load_moments(run.optimizer, moments)
    return state


def _read_newest(run: Run, reporter: Reporter) -> tuple[RunState, dict[str, Any] | None]:
    checkpoint = newest_checkpoint(run.folder / CHECKPOINTS)
    if checkpoint is None:
        return RunState(step=0, run_id=read_or_create_run_id(run.folder)), None
    load_trained(run.world_model, checkpoint / ADAPTER, trainable=True)
    try:
        moments = read_torch(checkpoint / OPTIMIZER)
        load_moments(run.optimizer, moments)
        state = read_state(checkpoint)
    except (ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        fix = "Undo the changes of the config, or delete this checkpoint to resume from an older one"
        raise InputError(where=str(checkpoint), found=f"not the state of this run ({error})", fix=fix) from None
    reporter.note(f"Resuming from {checkpoint} (step {state.step:,} of {run.config.training.steps:,}).")
    return replace(state, run_id=state.run_id or read_or_create_run_id(run.folder)), moments


def validation_settings(config: Config, dataset: Dataset) -> Mapping[str, str]:
    """Return the config values, and the hash of the clips, that determine the metrics of a validation."""
    settings = {key: json.dumps(value) for key, value in flatten(values_that_affect(Affects.MEASURED, config)).items()}
    windows = validation_windows(dataset, "validation", clips=config.validation.clips)
    clips = [(dataset.table.identity(episode), int(start)) for episode, start in windows]
    return {**settings, _CLIPS_KEY: hashlib.sha256(json.dumps(clips).encode()).hexdigest()[:16]}


def keep_comparable_best(state: RunState, settings: Mapping[str, str], reporter: Reporter) -> RunState:
    """Return the state to resume from; the best validation is removed if it was measured with other settings.

    Errors are comparable only for the same clips, time span and latents. Settings that are recorded only in `state` or
    only in `settings` are ignored.
    """
    before = state.validation_settings or {}
    differing = sorted(key for key in before.keys() & settings if before[key] != settings[key])
    state = replace(state, validation_settings=dict(settings))
    names = ["validation clips" if key == _CLIPS_KEY else key for key in differing]
    if not differing or state.best_error is None:
        return state
    reporter.note(
        f"The validation has changed ({', '.join(names)}): the best error so far, {state.best_error:.4g} at step"
        f" {state.best_step}, is not comparable and is discarded."
    )
    return replace(
        state,
        best_step=None,
        best_error=None,
        best_ranking_error=None,
        lowest_ranking_error=None,
        base_ranking_error=None,
    )


def count_micro_batches(config: Config, state: RunState, num_processes: int, reporter: Reporter) -> int:
    """Return the number of micro-batches per step, summed over all processes.

    At the first start, or after a change of batch_size * accumulation, the config determines the number. Otherwise the
    number of clips per step stays the same, with any number of processes. If the number of micro-batches is not a
    multiple of the number of processes, some processes have one micro-batch more than others.

    Raises:
        InputError: There are more processes than micro-batches.
    """
    batch_size, accumulation = config.training.batch_size, config.training.accumulation
    configured = accumulation * num_processes
    if state.clips_per_step is None or state.clips_per_process != batch_size * accumulation:
        return configured
    micro_batches = state.clips_per_step // batch_size
    if micro_batches < num_processes:
        problem = f"{counted(num_processes, 'process')}, each with micro-batches of {counted(batch_size, 'clip')}"
        clips = counted(state.clips_per_step, "clip")
        needed = f"at most {counted(micro_batches, 'process')}, because a step of this run has {clips}"
        fix = "Start fewer processes, or change training.batch_size and training.accumulation with"
        raise InputError(where="training.batch_size", found=problem, needed=needed, fix=f"{fix} --allow-config-change")
    if micro_batches != configured:
        fewest, remainder = divmod(micro_batches, num_processes)
        each = f"{fewest} or {fewest + 1}" if remainder else f"{fewest}"
        reporter.note(
            f"{counted(num_processes, 'process')} instead of {state.num_processes}: each computes {each} micro-batches"
            f" of {counted(batch_size, 'clip')}. A step still has {counted(state.clips_per_step, 'clip')}."
        )
    return micro_batches
