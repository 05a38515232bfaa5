"""The training loop: what happens before, during and after the steps.

What makes a run exact: the clips of a step, its learning rate and its random numbers are pure functions of (config,
step). A run that was killed continues from its newest checkpoint as if nothing had happened.
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
from typing import Any, Protocol, runtime_checkable

import torch

from vjepa2_ac.config import Config
from vjepa2_ac.config_file import config_as_dict
from vjepa2_ac.data.loader import validation_batches
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.metrics import PredictionErrors, one_step_ratios, prediction_errors, ratios_by_horizon
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.training.assembly import Run, assemble, batches_from, encode, make_accelerator, save_checkpoint
from vjepa2_ac.training.checkpoint import CheckpointClock
from vjepa2_ac.training.divergence import WatchedJournal
from vjepa2_ac.training.embodiment import NOT_ASKED
from vjepa2_ac.training.health import Throughput, TimedBatches
from vjepa2_ac.training.journal import Journal
from vjepa2_ac.training.mirror.mirror import Mirror, NoMirror
from vjepa2_ac.training.mirror.start import Remote, open_remote
from vjepa2_ac.training.optim import require_optimizer
from vjepa2_ac.training.preemption import StoppedError, stop_on_signals
from vjepa2_ac.training.processes import from_first, largest, require_same
from vjepa2_ac.training.quiet import QuietJournal, QuietReporter
from vjepa2_ac.training.resume import refuse_if_overtaken
from vjepa2_ac.training.run_folder import CALIBRATION, check_run_folder, config_changes, open_run_folder
from vjepa2_ac.training.run_lock import RunLock
from vjepa2_ac.training.start_folder import require_start_folder
from vjepa2_ac.training.step import gradients, training_step
from vjepa2_ac.training.stopwatch import stopwatch_for
from vjepa2_ac.training.stride import with_settled_stride
from vjepa2_ac.training.trackers import open_trackers, require_installed

BEST_BY = "rollout_over_persistence_last"  # checkpoint.keep_best: the longest look ahead is what planning leans on


@runtime_checkable
class Reporter(Protocol):
    """Shows a run to a person."""

    def note(self, text: str) -> None:
        """Say something once."""
        ...

    def looked_through(self, done: int, total: int) -> None:
        """So much of a data set that was not known before is looked through."""
        ...

    def encoded(self, done: int, total: int) -> None:
        """So many frames are encoded into the latent cache."""
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


def train(config: Config, reporter: Reporter, *, check_only: bool = False, allow_config_change: bool = False) -> Path:
    """Train as the config says, from the newest checkpoint of its run folder if there is one.

    Args:
        config: The run.
        reporter: Shows progress.
        check_only: Do everything that can fail, and stop before the first step and before anything is written.
        allow_config_change: Go on with this config where the run folder has another one, and say what changes.

    Returns:
        The folder of the run.

    Raises:
        InputError: Something the user gave cannot be used; raised before the first step wherever that can be known.
        StoppedError: A signal asked the run to stop between its first and last step; see `training.preemption`.
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
            if not check_only and Path(config.run_dir).is_dir():  # a new one is made, and locked, when all else is well
                lock.take()
            # What is checked only is fetched to where it does not last.
            trial = Path(until_the_end.enter_context(tempfile.TemporaryDirectory()), "run") if check_only else None
            # Taken before anything is fetched into the run's folder: whoever else came to it would still be writing.
            remote = open_remote(
                config,
                reporter.note,
                claim=lock.take if trial is None else lambda: None,
                allow_config_change=allow_config_change,
                into=trial,
            )
            config = with_settled_stride(remote.config if remote else config)
        else:
            reporter = QuietReporter()
        config = from_first(accelerator, config)
        until_the_end.enter_context(_out_of_memory_explained())
        run = assemble(
            config, reporter.note, reporter.looked_through, accelerator, reporter.encoded, check_only=check_only
        )
        try:
            return _train(run, lock, remote, reporter, check_only=check_only, allow_config_change=allow_config_change)
        except StoppedError:
            accelerator.end_training()
            raise


def _train(
    run: Run, lock: RunLock, remote: Remote | None, reporter: Reporter, *, check_only: bool, allow_config_change: bool
) -> Path:
    config, folder, writes = run.config, Path(run.config.run_dir), run.accelerator.is_main_process
    first = _validate(run, reporter) if run.state.step == 0 else None
    if first is not None:
        _refuse_weak_base(run, first, reporter)
    if allow_config_change and writes:
        for line in config_changes(config):
            reporter.note(f"The config changes: {line}")
    if check_only:
        gradients(run, batches_from(run))
        reporter.note("Everything is in place: data, model, validation and gradients were tried; nothing was written.")
        return folder
    if writes:
        lock.take()
        refuse_if_overtaken(folder, run.state)
        open_run_folder(config, run.state.run_id, allow_config_change=allow_config_change)
    if run.calibration is not None and writes:
        write_atomically(folder / CALIBRATION, json.dumps(run.calibration.as_dict(), indent=1).encode())
    with _open_journal(run, folder, reporter) as journal:
        if first is not None:
            journal.write("validation", 0, validation_figures(first))
        with remote.mirror(run.state.run_id) if remote else NoMirror() as mirror:
            _loop(run, folder, journal, mirror, reporter)
    run.accelerator.end_training()
    return folder


def _open_journal(run: Run, folder: Path, reporter: Reporter) -> Journal | QuietJournal:
    if not run.accelerator.is_main_process:
        return QuietJournal()
    done = run.state.step
    trackers = open_trackers(run.config, folder, run_id=run.state.run_id, first_step=done)
    return WatchedJournal(folder, config=run.config, note=reporter.note, first_step=done, trackers=trackers)


def _loop(
    run: Run, folder: Path, journal: Journal | QuietJournal, mirror: Mirror | NoMirror, reporter: Reporter
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
            figures = _timed_step(run, timed, step, throughput, measure_update=is_logged)
            reporter.stepped(step, figures)
            if is_logged:
                journal.write("train", step, figures)
            run.state = replace(run.state, step=step, clips_done=run.state.clips_done + run.clips_per_step)
            is_best = _validate_if_due(run, journal, reporter)
            # Agreed among all processes, and read once: a signal after this waits for the next step.
            is_due = clock.is_due(step) or is_best or last or journal.is_behind
            stopped_by, due = largest(run.accelerator, [stop.number, is_due])
            if due or stopped_by:
                with journal.before_a_checkpoint():
                    save_checkpoint(run, folder)
                clock.restart()
            mirror.tick()
            if stopped_by and not last:
                mirror.finish(lambda: True)
                run.accelerator.wait_for_everyone()  # whoever ended first would have the others ended by the launcher
                raise StoppedError(folder, step, signal.Signals(stopped_by).name)
        mirror.finish(lambda: stop.reason is not None)
    run.accelerator.wait_for_everyone()


def _timed_step(
    run: Run, batches: TimedBatches, step: int, throughput: Throughput, *, measure_update: bool
) -> dict[str, float]:
    started, waited_s = time.perf_counter(), batches.waited_s
    figures = training_step(run, batches, step, measure_update=measure_update)
    clips = run.clips_per_step - figures.get("clips_left_out", 0.0)
    return figures | throughput.figures(clips, time.perf_counter() - started, batches.waited_s - waited_s)


def _validate_if_due(run: Run, journal: Journal | QuietJournal, reporter: Reporter) -> bool:
    """Measure and note, where it is time to; return whether no earlier measurement was as good."""
    step, config = run.state.step, run.config
    if step % config.validation.every != 0 and step != config.training.steps:
        return False
    figures = validation_figures(_validate(run, reporter))
    journal.write("validation", step, figures)
    if not config.checkpoint.keep_best:
        return False
    before = run.state
    run.state = before.measured(figures[BEST_BY])
    return run.state != before


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


def _validate(run: Run, reporter: Reporter) -> PredictionErrors:
    config = run.config
    run.world_model.eval()
    batches = validation_batches(
        run.dataset,
        "validation",
        clips=config.validation.clips,
        batch_size=config.validation.batch_size,
        copies=run.copies,
    )
    with run.accelerator.autocast():
        errors = prediction_errors(run.world_model, (encode(run, batch) for batch in batches))
    reporter.validated(run.state.step, errors)
    return errors


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


def _refuse_weak_base(run: Run, errors: PredictionErrors, reporter: Reporter) -> None:
    config, error = run.config, one_step_ratios(errors)["true"].value
    if error < 1.0 or config.training.allow_weak_base or config.model.random is not None:
        return
    if run.world_model.fresh_heads is not None:
        reporter.note(NOT_ASKED)
        return
    raise InputError(
        where="model.base",
        found=f"on the validation clips its one-step error is {error:.2f} times that of copying the last frame",
        needed="a base that is better than doing nothing (below 1)",
        fix="Check the checkpoint, data.stride, data.camera, the order of the state and the gripper's direction;"
        " to adapt it all the same, set training.allow_weak_base=true",
    )
