"""The training loop: what happens before, during and after the steps.

A run is reproducible because the clips of a step, its learning rate and its random numbers are pure functions of
(config, step). A run that was killed continues from its newest checkpoint as if it had not been interrupted.
"""

from __future__ import annotations

import contextlib
import json
import math
import signal
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_dict
from vjepa2_ac.distributed import (
    agreed,
    all_reduce_max,
    broadcast_object,
    first_only,
    joined,
    leave_processes,
    require_same,
)
from vjepa2_ac.errors import UnreachableError, counted
from vjepa2_ac.process import StoppedError, stop_on_signals
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.runs.checkpoint import CHECKPOINTS, RunState, newest_checkpoint, read_state
from vjepa2_ac.runs.folder import CALIBRATION, CHANGES, asks_nothing_new, config_changes, read_run_config, write_config
from vjepa2_ac.runs.metrics_log import MetricsLog
from vjepa2_ac.runs.open_run import OpenRun, open_run
from vjepa2_ac.runs.trackers import open_trackers, require_installed
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.training.monitoring import Throughput, TimedBatches, WatchedMetricsLog
from vjepa2_ac.training.optim import describe_changed_rate, require_optimizer
from vjepa2_ac.training.resume import restore, save_checkpoint
from vjepa2_ac.training.setup import Run, batches_from, set_up
from vjepa2_ac.training.step import gradients, training_step
from vjepa2_ac.training.validation import is_done, record, validate_base, validate_if_due, validation_metrics

if TYPE_CHECKING:
    from vjepa2_ac.runs.mirror import Mirror

_IN_PLACE = "Everything is in place: data, model, validation and gradients were checked; nothing was written."


def train(config: Config, reporter: Reporter, *, check_only: bool = False, allow_config_change: bool = False) -> Path:
    """Train by a config, from the newest checkpoint of its run folder if there is one.

    Args:
        config: The run.
        reporter: Shows progress.
        check_only: Do everything that can fail, and stop before the first step and before anything is written.
        allow_config_change: Continue with this config if the run folder has another one, and report the changes.

    Returns:
        The folder of the run.

    Raises:
        InputError: An input cannot be used; raised before the first step wherever possible.
        StoppedError: A signal asked the run to stop between its first and last step; see `process`.
    """
    with contextlib.ExitStack() as until_the_end, joined(config) as accelerator:
        require_same(accelerator, config_as_dict(config), what="the config", fix="Start all processes with one config")
        require_optimizer(config.training)
        reporter = reporter if accelerator.is_main_process else SILENT

        def opening() -> OpenRun:
            require_installed(config.tracking)
            here = open_run(config, reporter, check_only=check_only, allow_config_change=allow_config_change)
            return until_the_end.enter_context(here)

        # The first process is the only one that reports, has trackers and needs to see the run's folder.
        opened = first_only(accelerator, opening)
        config = broadcast_object(accelerator, opened.config if opened else config)
        ended = first_only(accelerator, lambda: opened and not check_only and _has_ended(opened, reporter))
        if not broadcast_object(accelerator, ended):
            changes = {"check_only": check_only, "allow_config_change": allow_config_change}
            run = restore(set_up(config, reporter, accelerator, **changes), reporter)
            first = validate_base(run, reporter)
            if opened:
                _report_changes(run, reporter)
            if check_only:
                reporter.task("computing one optimizer step")
                gradients(run, batches_from(run))
                reporter.note(_IN_PLACE)
            else:
                beginning = partial(_begun, run, opened, reporter, until_the_end)
                metrics_log, mirror = agreed(accelerator, beginning) or (None, None)
                if first is not None and record(run, validation_metrics(first), metrics_log):
                    _save(run, metrics_log)  # the base: nothing that is worse is ever selected
                _loop(run, metrics_log, mirror, reporter)
    leave_processes()
    return Path(config.run_dir)


def _has_ended(opened: OpenRun, reporter: Reporter) -> bool:
    """Return whether the run has ended already; then write its config, and send what `checkpoint.remote` lacks."""
    config, newest = opened.config, newest_checkpoint(Path(opened.config.run_dir, CHECKPOINTS))
    if newest is None or not (asks_nothing_new(config) and is_done(config, state := read_state(newest))):
        return False
    write_config(config)
    reporter.note(_why_ended(config, state))
    if (mirror := opened.mirror(state.run_id)) is not None:
        with mirror:
            mirror.finish(lambda: False)
    return True


def _why_ended(config: Config, state: RunState) -> str:
    """Return why training ends at a step."""
    if state.step >= config.training.steps:
        return f"Training is finished after {counted(config.training.steps, 'step')} (training.steps)."
    return (
        f"Training ends at step {state.step:,}: step {state.best_step:,} is the best, and"
        f" no better one followed in {counted(config.training.patience or 0, 'validation')} (training.patience)."
    )


def _report_changes(run: Run, reporter: Reporter) -> None:
    """Print the settings that differ from those of the last start, and a learning rate that follows from them."""
    changes = config_changes(run.config)
    for line in changes:
        reporter.note(f"The config changes: {line}")
    before = read_run_config(run.folder) if changes else run.config
    if rate := describe_changed_rate(run.state.step, before.training, run.config.training):
        reporter.note(rate)


def _begun(
    run: Run, opened: OpenRun | None, reporter: Reporter, until_the_end: contextlib.ExitStack
) -> tuple[MetricsLog, Mirror | None] | None:
    """Open the metrics log and the mirror, in the first process; they end after all others have heard of an error."""
    if opened is None:
        return None
    opened.begin(run.config, run.state)
    _write_measured(run)
    done, run_id = run.state.step, run.state.run_id
    trackers = open_trackers(run.config, run.folder, run_id=run_id, first_step=done)
    watched = WatchedMetricsLog(run.config, reporter, first_step=done, trackers=trackers)
    metrics_log, mirror = until_the_end.enter_context(watched), opened.mirror(run_id)
    if mirror is not None:
        until_the_end.enter_context(mirror)
    return metrics_log, mirror


def _write_measured(run: Run) -> None:
    """Write what the data and the base have shown: the metrics of a chosen stride, and what the actions teach."""
    from vjepa2_ac.inspection.coverage import coverage_in

    folder = run.folder
    if run.calibration is not None:
        write_atomically(folder / CALIBRATION, json.dumps(run.calibration.as_dict(), indent=1).encode())
    if not (folder / CHANGES).exists() and (coverage := coverage_in(run.dataset)) is not None:
        write_atomically(folder / CHANGES, json.dumps(coverage.noted()).encode())


def _save(run: Run, metrics_log: MetricsLog | None) -> None:
    """Write a checkpoint, after the metrics that lead to it."""

    def save() -> None:
        with metrics_log.before_a_checkpoint() if metrics_log else contextlib.nullcontext():
            save_checkpoint(run, run.folder)

    agreed(run.accelerator, save)


def _loop(run: Run, metrics_log: MetricsLog | None, mirror: Mirror | None, reporter: Reporter) -> None:
    training = run.config.training
    device, processes = run.accelerator.device, run.accelerator.num_processes
    throughput = Throughput.of(run.config, run.world_model.sizes, device, processes)
    reporter.started(run.state.step, training.steps)
    checkpoint, saved_s, saved_step = run.config.checkpoint, time.monotonic(), run.state.step
    every_s = math.inf if checkpoint.every_minutes is None else 60.0 * checkpoint.every_minutes
    with stop_on_signals() as stop, contextlib.closing(batches_from(run)) as batches:
        timed, stopped_by = TimedBatches(batches, device), 0
        while not (stopped_by or is_done(run.config, run.state)):
            step = run.state.step + 1
            is_logged = step % training.log_every == 0 or step == training.steps
            try:
                metrics = _timed_step(run, timed, step, throughput, measure_update=is_logged)
            except UnreachableError:  # after a signal, data that do not come end the run before the step
                if not stop.number or processes > 1:
                    raise
                stopped_by = stop.number
                if run.state.step > saved_step:
                    _save(run, metrics_log)
                break
            reporter.stepped(step, metrics)
            if is_logged and metrics_log:
                metrics_log.write("train", step, metrics)
            run.state = replace(run.state, step=step, clips_done=run.state.clips_done + run.clips_per_step)
            is_best = validate_if_due(run, metrics_log, reporter)
            # Agreed among all processes, and read once: a signal after this takes effect at the next step.
            is_due = step % checkpoint.every == 0 or time.monotonic() - saved_s >= every_s or is_best
            is_due = is_due or is_done(run.config, run.state) or bool(metrics_log and metrics_log.is_behind)
            stopped_by, due = all_reduce_max(run.accelerator, [stop.number, is_due])
            if due or stopped_by:
                _save(run, metrics_log)
                saved_s, saved_step = time.monotonic(), step
            if mirror:
                mirror.tick()
        has_ended = is_done(run.config, run.state)
        if has_ended and run.state.step < training.steps:
            reporter.note(_why_ended(run.config, run.state))
        # All wait: the launcher ends all processes once one has ended.
        agreed(run.accelerator, lambda: mirror.finish(lambda: not has_ended or bool(stop.number)) if mirror else None)
    if not has_ended:
        raise StoppedError(run.folder, run.state.step, signal.Signals(stopped_by).name)


def _timed_step(
    run: Run, batches: TimedBatches, step: int, throughput: Throughput, *, measure_update: bool
) -> dict[str, float]:
    started, waited_s = time.perf_counter(), batches.waited_s
    metrics = training_step(run, batches, step, measure_update=measure_update)
    clips = run.clips_per_step - metrics.get("clips_left_out", 0.0)
    return metrics | throughput.metrics(clips, time.perf_counter() - started, batches.waited_s - waited_s)
