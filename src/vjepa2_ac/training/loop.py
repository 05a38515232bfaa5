"""The training loop.

A run is reproducible because the clips of a step, its learning rate and its random numbers are pure functions of
(config, step). A killed run resumes from its newest checkpoint, with the same result as an uninterrupted run.
`examples/train_loop.py` is the same algorithm without processes, checkpoints and signals.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_dict
from vjepa2_ac.distributed import join_processes, leave_processes, require_same
from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.training.monitoring import Throughput, TimedBatches
from vjepa2_ac.training.optim import require_optimizer
from vjepa2_ac.training.outputs import RunOutputs
from vjepa2_ac.training.resume import restore
from vjepa2_ac.training.setup import set_up
from vjepa2_ac.training.step import Run, compute_gradients, iterate_batches, training_step
from vjepa2_ac.training.validation import record, validate_base, validate_if_due

_CHECKS_PASSED = "All checks passed: data, model, validation and gradients. Nothing was written."


def train(config: Config, reporter: Reporter, *, check_only: bool = False, allow_config_change: bool = False) -> Path:
    """Train as a config describes, and resume from the newest checkpoint in the run folder if there is one.

    Args:
        config: The config of the run.
        reporter: Shows progress.
        check_only: Run all checks, then stop before the first step without writing anything.
        allow_config_change: Continue with this config if the run folder has another one, and report the changes.

    Returns:
        The folder of the run.

    Raises:
        InputError: An input cannot be used; raised before the first step wherever possible.
        StoppedError: A signal stopped the run before its last step; see `process`.
    """
    changes = {"check_only": check_only, "allow_config_change": allow_config_change}
    with contextlib.ExitStack() as exit_stack, join_processes(config) as accelerator:
        require_same(
            accelerator, config_as_dict(config), what="the config", fix="Start all processes with the same config"
        )
        require_optimizer(config.training)
        reporter = reporter if accelerator.is_main_process else SILENT
        outputs = RunOutputs(config, reporter, accelerator, exit_stack, **changes)
        if not outputs.has_ended:
            run = restore(set_up(outputs.config, reporter, accelerator, **changes), reporter)
            base_validation = validate_base(run, reporter)
            outputs.report_changes(run)
            if check_only:
                reporter.task("computing one optimizer step")
                compute_gradients(run, iterate_batches(run))
                reporter.note(_CHECKS_PASSED)
            else:
                outputs.begin(run)
                if base_validation is not None and record(run, base_validation, outputs.metrics_log):
                    outputs.save()  # the untrained state, so that no worse checkpoint can become the best one
                _optimize(run, outputs, reporter)
    leave_processes()
    return Path(outputs.config.run_dir)


def _optimize(run: Run, outputs: RunOutputs, reporter: Reporter) -> None:
    """Run the remaining steps."""
    reporter.on_start(run.state.step, run.config.training.steps)
    throughput = Throughput.measure(run.config, run.world_model.sizes, run.accelerator)
    with contextlib.closing(iterate_batches(run)) as batches:
        timed = TimedBatches(batches, run.accelerator.device)
        while outputs.has_next_step:
            step, started_s, waited_s = run.state.step + 1, time.perf_counter(), timed.waited_s
            try:
                metrics = training_step(run, timed, step, measure_update=outputs.is_logged(step))
            except UnreachableError:
                if not outputs.stops_without_data():
                    raise
                break
            run.state = replace(run.state, step=step, clips_done=run.state.clips_done + run.clips_per_step)
            num_clips = run.clips_per_step - metrics.get("clips_left_out", 0.0)
            metrics |= throughput.compute_metrics(num_clips, time.perf_counter() - started_s, timed.waited_s - waited_s)
            outputs.on_step(metrics)
            is_best = validate_if_due(run, outputs.metrics_log, reporter)
            outputs.save_if_due(is_best=is_best)
    outputs.finish()
