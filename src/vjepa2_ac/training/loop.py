"""The training loop: what happens before, during and after the steps.

A run is reproducible because the clips of a step, its learning rate and its random numbers are pure functions of
(config, step). A run that was killed continues from its newest checkpoint as if it had not been interrupted.
"""

from __future__ import annotations

import contextlib
import json
import signal
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_dict
from vjepa2_ac.distributed.collectives import all_reduce_max, broadcast_object, require_same
from vjepa2_ac.distributed.launch import make_accelerator
from vjepa2_ac.distributed.preemption import StoppedError, stop_on_signals
from vjepa2_ac.errors import InputError
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.checkpoint import CheckpointClock
from vjepa2_ac.runs.folder import CALIBRATION, check_run_folder, config_changes, open_run_folder, with_settled_stride
from vjepa2_ac.runs.lock import RunLock
from vjepa2_ac.runs.metrics_log import MetricsLog
from vjepa2_ac.runs.mirror.background_sync import Mirror, NoMirror
from vjepa2_ac.runs.mirror.open_remote import Remote, open_remote
from vjepa2_ac.runs.relative_paths import require_start_folder
from vjepa2_ac.runs.trackers import open_trackers, require_installed
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.training.monitoring.divergence import WatchedMetricsLog
from vjepa2_ac.training.monitoring.stopwatch import stopwatch_for
from vjepa2_ac.training.monitoring.throughput import Throughput, TimedBatches
from vjepa2_ac.training.optim import require_optimizer
from vjepa2_ac.training.reporter import NullMetricsLog, TrainingReporter
from vjepa2_ac.training.resume import refuse_if_overtaken, require_same_data
from vjepa2_ac.training.setup import Run, batches_from, save_checkpoint, set_up
from vjepa2_ac.training.step import gradients, training_step
from vjepa2_ac.training.validation import refuse_weak_base, validate, validate_if_due, validation_metrics


def train(
    config: Config, reporter: TrainingReporter, *, check_only: bool = False, allow_config_change: bool = False
) -> Path:
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
        StoppedError: A signal asked the run to stop between its first and last step; see `distributed.preemption`.
    """
    accelerator = make_accelerator(config)
    require_same(accelerator, config_as_dict(config), what="the config", fix="Start all processes with one config")
    require_optimizer(config.training)
    if accelerator.is_main_process:  # the only one that has trackers
        require_installed(config.tracking)
    remote = None
    with contextlib.ExitStack() as until_the_end:
        lock = until_the_end.enter_context(RunLock(Path(config.run_dir)))
        if accelerator.is_main_process:  # the only one that needs to see the run's folder
            config = with_settled_stride(config)
            check_run_folder(config, allow_config_change=allow_config_change)
            require_start_folder(config, Path(config.run_dir))
            if not check_only and Path(config.run_dir).is_dir():  # a new one is created, and locked, after all checks
                lock.take()
            # A check downloads into a temporary folder.
            trial = Path(until_the_end.enter_context(tempfile.TemporaryDirectory()), "run") if check_only else None
            # Locked before anything is downloaded into the run's folder: another process could still be writing there.
            remote = open_remote(
                config,
                reporter,
                claim=lock.take if trial is None else lambda: None,
                allow_config_change=allow_config_change,
                into=trial,
            )
            config = with_settled_stride(remote.config if remote else config)
        else:
            reporter = SILENT
        config = broadcast_object(accelerator, config)
        until_the_end.enter_context(_out_of_memory_explained())
        run = set_up(config, reporter, accelerator, check_only=check_only)
        try:
            return _train(run, lock, remote, reporter, check_only=check_only, allow_config_change=allow_config_change)
        except StoppedError:
            accelerator.end_training()
            raise


def _train(
    run: Run,
    lock: RunLock,
    remote: Remote | None,
    reporter: TrainingReporter,
    *,
    check_only: bool,
    allow_config_change: bool,
) -> Path:
    config, folder, writes = run.config, Path(run.config.run_dir), run.accelerator.is_main_process
    if writes and not allow_config_change:
        require_same_data(config, run.dataset, run.state)
    first = validate(run, reporter) if run.state.step == 0 else None
    if first is not None:
        refuse_weak_base(run, first, reporter)
    if allow_config_change and writes:
        for line in config_changes(config):
            reporter.note(f"The config changes: {line}")
    if check_only:
        gradients(run, batches_from(run))
        reporter.note(
            "Everything is in place: data, model, validation and gradients were checked; nothing was written."
        )
        return folder
    if writes:
        lock.take()
        refuse_if_overtaken(folder, run.state)
        open_run_folder(config, run.state.run_id, allow_config_change=allow_config_change)
    if run.calibration is not None and writes:
        write_atomically(folder / CALIBRATION, json.dumps(run.calibration.as_dict(), indent=1).encode())
    with _open_metrics_log(run, folder, reporter) as metrics_log:
        if first is not None:
            metrics_log.write("validation", 0, validation_metrics(first))
        with remote.mirror(run.state.run_id) if remote else NoMirror() as mirror:
            _loop(run, folder, metrics_log, mirror, reporter)
    run.accelerator.end_training()
    return folder


def _open_metrics_log(run: Run, folder: Path, reporter: TrainingReporter) -> MetricsLog | NullMetricsLog:
    if not run.accelerator.is_main_process:
        return NullMetricsLog()
    done = run.state.step
    trackers = open_trackers(run.config, folder, run_id=run.state.run_id, first_step=done)
    return WatchedMetricsLog(folder, config=run.config, reporter=reporter, first_step=done, trackers=trackers)


def _loop(
    run: Run,
    folder: Path,
    metrics_log: MetricsLog | NullMetricsLog,
    mirror: Mirror | NoMirror,
    reporter: TrainingReporter,
) -> None:
    training = run.config.training
    device, processes = run.accelerator.device, run.accelerator.num_processes
    throughput = Throughput.of(run.config, run.world_model.sizes, device, processes, encodes=run.encodes)
    reporter.note(str(throughput))
    reporter.started(run.state.step, training.steps)
    clock = CheckpointClock(run.config.checkpoint)
    with stop_on_signals() as stop, contextlib.closing(batches_from(run)) as batches:
        timed = TimedBatches(batches, stopwatch_for(device))
        for step in range(run.state.step + 1, training.steps + 1):
            last = step == training.steps
            is_logged = step % training.log_every == 0 or last
            metrics = _timed_step(run, timed, step, throughput, measure_update=is_logged)
            reporter.stepped(step, metrics)
            if is_logged:
                metrics_log.write("train", step, metrics)
            run.state = replace(run.state, step=step, clips_done=run.state.clips_done + run.clips_per_step)
            is_best = validate_if_due(run, metrics_log, reporter)
            # Agreed among all processes, and read once: a signal after this takes effect at the next step.
            is_due = clock.is_due(step) or is_best or last or metrics_log.is_behind
            stopped_by, due = all_reduce_max(run.accelerator, [stop.number, is_due])
            if due or stopped_by:
                with metrics_log.before_a_checkpoint():
                    save_checkpoint(run, folder)
                clock.restart()
            mirror.tick()
            if stopped_by and not last:
                mirror.finish(lambda: True)
                run.accelerator.wait_for_everyone()  # the launcher ends all processes once one has ended
                raise StoppedError(folder, step, signal.Signals(stopped_by).name)
        mirror.finish(lambda: stop.reason is not None)
    run.accelerator.wait_for_everyone()


def _timed_step(
    run: Run, batches: TimedBatches, step: int, throughput: Throughput, *, measure_update: bool
) -> dict[str, float]:
    started, waited_s = time.perf_counter(), batches.waited_s
    metrics = training_step(run, batches, step, measure_update=measure_update)
    clips = run.clips_per_step - metrics.get("clips_left_out", 0.0)
    return metrics | throughput.metrics(clips, time.perf_counter() - started, batches.waited_s - waited_s)


@contextlib.contextmanager
def _out_of_memory_explained() -> Iterator[None]:
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise InputError(
            where="training",
            found=f"the GPU's memory is not enough ({str(error).splitlines()[0]})",
            fix="Set training.gradient_checkpointing=true, or lower training.batch_size (and raise"
            " training.accumulation), model.encode_chunk or validation.batch_size",
        ) from error
