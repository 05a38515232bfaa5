"""Validation of a run on held-out clips, and the check that its base is worth adapting."""

from __future__ import annotations

from typing import Any

from vjepa2_ac.data.clips.loader import validation_batches
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.estimates import one_step_over_persistence, over_persistence
from vjepa2_ac.evaluation.measure import prediction_errors
from vjepa2_ac.evaluation.result import PredictionErrors
from vjepa2_ac.runs.metrics_log import MetricsLog
from vjepa2_ac.training.new_embodiment import NOT_ASKED
from vjepa2_ac.training.reporter import NullMetricsLog, TrainingReporter
from vjepa2_ac.training.setup import Run, encode

BEST_BY = "rollout_over_persistence_last"  # checkpoint.keep_best: planning depends on the longest horizon


def validate_if_due(run: Run, metrics_log: MetricsLog | NullMetricsLog, reporter: TrainingReporter) -> bool:
    """Measure and log the validation, if it is due; return whether it is the best so far."""
    step, config = run.state.step, run.config
    if step % config.validation.every != 0 and step != config.training.steps:
        return False
    metrics = validation_metrics(validate(run, reporter))
    metrics_log.write("validation", step, metrics)
    if not config.checkpoint.keep_best:
        return False
    before = run.state
    run.state = before.measured(metrics[BEST_BY])
    return run.state != before


def validation_metrics(errors: PredictionErrors) -> dict[str, Any]:
    """Return what a validation writes into the metrics log."""
    by_horizon = over_persistence(errors, "rollout")
    return {
        "error_over_persistence": one_step_over_persistence(errors).value,
        "error_over_persistence_zero_actions": one_step_over_persistence(errors, "zero").value,
        "error_over_persistence_shuffled_actions": one_step_over_persistence(errors, "shuffled").value,
        "rollout_over_persistence": [r.value for r in by_horizon],
        "rollout_over_persistence_last": by_horizon[-1].value,
    }


def validate(run: Run, reporter: TrainingReporter) -> PredictionErrors:
    """Measure the held-out clips."""
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


def validate_base(run: Run, reporter: TrainingReporter) -> PredictionErrors | None:
    """Measure a run before its first step, and refuse a base that is no better than copying the last frame.

    None is returned of a run that goes on.

    Raises:
        InputError: It is not, and `training.allow_weak_base` is off.
    """
    if run.state.step:
        return None
    errors = validate(run, reporter)
    config, error = run.config, one_step_over_persistence(errors).value
    if error < 1.0 or config.training.allow_weak_base or config.model.random is not None:
        return errors
    if run.world_model.fresh_heads is not None:
        reporter.note(NOT_ASKED)
        return errors
    raise InputError(
        where="model.base",
        found=f"on the validation clips its one-step error is {error:.2f} times that of copying the last frame",
        needed="a base that is better than doing nothing (below 1)",
        fix="Check the checkpoint, data.stride, data.camera, the order of the state and the gripper's direction;"
        " to adapt it anyway, set training.allow_weak_base=true",
    )
