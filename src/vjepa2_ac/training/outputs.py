"""Outputs of a training run: run folder, metrics log, checkpoints and mirror. Also handles the signals that stop it."""

from __future__ import annotations

import contextlib
import json
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

from accelerate import Accelerator

from vjepa2_ac.config import Config
from vjepa2_ac.distributed import all_reduce, broadcast_object, run_on_all, run_on_first
from vjepa2_ac.errors import counted
from vjepa2_ac.process import StoppedError, stop_on_signals
from vjepa2_ac.registry import TRAINING_HOOKS
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import CHECKPOINTS, RunState, newest_checkpoint, read_state
from vjepa2_ac.runs.folder import (
    CALIBRATION,
    CHANGES,
    has_same_results,
    list_config_changes,
    read_run_config,
    write_config,
)
from vjepa2_ac.runs.metrics_log import MetricsLog, open_trackers, require_installed
from vjepa2_ac.runs.open_run import OpenRun, open_run
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.training.monitoring import DivergenceWarningLog
from vjepa2_ac.training.optim import describe_changed_rate
from vjepa2_ac.training.resume import save_checkpoint
from vjepa2_ac.training.step import Run
from vjepa2_ac.training.validation import is_finished

if TYPE_CHECKING:
    from vjepa2_ac.runs.mirror import Mirror

SAVE_EVERY_S = 15 * 60.0  # in addition to checkpoint.every


class RunOutputs:
    """The outputs of a run, updated by the training loop after each step.

    Only the first process writes; all processes decide together when to save and when to stop.

    Args:
        config: The config of the run.
        reporter: Receives messages.
        accelerator: The processes of the run.
        exit_stack: An exit stack that closes everything that is opened here.
        check_only: Write nothing.
        allow_config_change: Accept that the run in the folder has another config.

    Raises:
        InputError: See `open_run`.
    """

    def __init__(
        self,
        config: Config,
        reporter: Reporter,
        accelerator: Accelerator,
        exit_stack: contextlib.ExitStack,
        *,
        check_only: bool,
        allow_config_change: bool,
    ) -> None:
        self._reporter, self._exit_stack = reporter, exit_stack
        self.metrics_log: MetricsLog | None = None
        self._mirror: Mirror | None = None
        self._stopped_by = 0  # number of the signal that stopped the run; 0: none
        self._saved_s, self._saved_step = 0.0, 0  # of the last checkpoint: `begin` sets both

        def open_folder() -> OpenRun:
            require_installed(config.tracking)
            context = open_run(config, reporter, check_only=check_only, allow_config_change=allow_config_change)
            return exit_stack.enter_context(context)

        self._open_run = run_on_first(accelerator, open_folder)  # None in other processes
        self.config = broadcast_object(accelerator, self._open_run.config if self._open_run else config)
        has_ended = run_on_first(accelerator, lambda: not check_only and self._finish_if_ended())
        self.has_ended = bool(broadcast_object(accelerator, has_ended))

    def _finish_if_ended(self) -> bool:
        """Return whether the run has ended already; if so, write the config and finish the mirror."""
        newest = newest_checkpoint(Path(self.config.run_dir, CHECKPOINTS))
        if (
            newest is None
            or not has_same_results(self.config)
            or not is_finished(self.config, state := read_state(newest))
        ):
            return False
        write_config(self.config)
        self._reporter.note(_describe_end(self.config, state))
        if self._open_run is not None and (mirror := self._open_run.mirror(state.run_id)) is not None:
            with mirror:
                mirror.finish(lambda: False)
        return True

    def report_changes(self, run: Run) -> None:
        """Print the config changes since the last start, and the learning rate if a change affects it."""
        if self._open_run is None:
            return
        changes = list_config_changes(run.config)
        for line in changes:
            self._reporter.note(f"Config change: {line}")
        before = read_run_config(run.folder) if changes else run.config
        if rate := describe_changed_rate(run.state.step, before.training, run.config.training):
            self._reporter.note(rate)

    def begin(self, run: Run) -> None:
        """Open the metrics log, the trackers and the mirror, and install the signal handlers."""
        self._run, self._saved_step, self._saved_s = run, run.state.step, time.monotonic()
        run_on_all(run.accelerator, self._open_files)
        self._stop = self._exit_stack.enter_context(stop_on_signals())

    def _open_files(self) -> None:
        if self._open_run is None:
            return
        run, step, run_id = self._run, self._run.state.step, self._run.state.run_id
        self._open_run.begin(run.config, run.state)
        if run.calibration is not None:
            write_atomically(run.folder / CALIBRATION, json.dumps(run.calibration, indent=1).encode())
        measure_coverage = TRAINING_HOOKS.find("coverage")
        if not (run.folder / CHANGES).exists() and (coverage := measure_coverage(run.dataset)) is not None:
            write_atomically(run.folder / CHANGES, json.dumps(coverage.as_record()).encode())
        trackers = open_trackers(run.config, run.folder, run_id=run_id, first_step=step)
        metrics_log = DivergenceWarningLog(run.config, self._reporter, first_step=step, trackers=trackers)
        self.metrics_log = self._exit_stack.enter_context(metrics_log)
        if (mirror := self._open_run.mirror(run_id)) is not None:
            self._mirror = self._exit_stack.enter_context(mirror)

    @property
    def has_next_step(self) -> bool:
        """Whether another step follows."""
        return not (self._stopped_by or is_finished(self._run.config, self._run.state))

    def is_logged(self, step: int) -> bool:
        """Return whether a step is written into the metrics log."""
        training = self._run.config.training
        return step % training.log_every == 0 or step == training.steps

    def on_step(self, metrics: dict[str, float]) -> None:
        """Show and log the metrics of the current step."""
        step = self._run.state.step
        self._reporter.on_step(step, metrics)
        if self.metrics_log is not None and self.is_logged(step):
            self.metrics_log.write("train", step, metrics)

    def save_if_due(self, *, is_best: bool) -> None:
        """Save a checkpoint if it is due or a signal was received, and start an upload if the mirror is due.

        All processes decide together. The signal is read once: a later signal takes effect at the next step.
        """
        run, step = self._run, self._run.state.step
        is_due = step % run.config.checkpoint.every == 0 or time.monotonic() - self._saved_s >= SAVE_EVERY_S
        is_due = is_due or is_best or is_finished(run.config, run.state)
        is_due = is_due or (self.metrics_log is not None and self.metrics_log.has_unwritten_rows)
        stopped_by, is_due_anywhere = all_reduce(run.accelerator, [self._stop.number, is_due], "max")
        self._stopped_by = int(stopped_by)
        if is_due_anywhere or self._stopped_by:
            self.save()
        if self._mirror is not None:
            self._mirror.upload_if_due()

    def save(self) -> None:
        """Save a checkpoint, after writing the metrics of all steps before it."""

        def write() -> None:
            with self.metrics_log.flush_before_checkpoint() if self.metrics_log else contextlib.nullcontext():
                save_checkpoint(self._run, self._run.folder)

        run_on_all(self._run.accelerator, write)
        self._saved_s, self._saved_step = time.monotonic(), self._run.state.step

    def stops_without_data(self) -> bool:
        """Return whether to stop because a signal was received while the data cannot be reached; save unsaved steps."""
        if not self._stop.number or self._run.accelerator.num_processes > 1:
            return False
        self._stopped_by = self._stop.number
        if self._run.state.step > self._saved_step:
            self.save()
        return True

    def finish(self) -> None:
        """Finish the uploads of the mirror.

        Raises:
            StoppedError: A signal stopped the run before its last step.
        """
        run = self._run
        has_ended = is_finished(run.config, run.state)
        if has_ended and run.state.step < run.config.training.steps:
            self._reporter.note(_describe_end(run.config, run.state))

        def finish_mirror() -> None:
            if self._mirror is not None:
                self._mirror.finish(lambda: not has_ended or bool(self._stop.number))

        run_on_all(run.accelerator, finish_mirror)  # all processes wait, because the launcher ends all when one exits
        if not has_ended:
            raise StoppedError(run.folder, run.state.step, signal.Signals(self._stopped_by).name)


def _describe_end(config: Config, state: RunState) -> str:
    """Return why training ends at a step."""
    if state.step >= config.training.steps:
        return f"Training is finished after {counted(config.training.steps, 'step')} (training.steps)."
    return (
        f"Training stops at step {state.step:,}: no improvement since step {state.best_step:,}, in"
        f" {counted(config.training.patience or 0, 'validation')} (training.patience)."
    )
