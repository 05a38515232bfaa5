"""Validation of a run on held-out clips, and the check that its base is worth adapting."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator
from functools import partial
from itertools import islice
from typing import Any

from vjepa2_ac.config import Config
from vjepa2_ac.data.loader import batches_of, validation_windows
from vjepa2_ac.data.windows import spread
from vjepa2_ac.distributed import broadcast_object, gathered, own_part, sharing
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.action_use import RolloutStart, gathered_starts, moves_of, rank_actions
from vjepa2_ac.evaluation.measure import actions_before, prediction_errors
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import Validation, cost_of_actions, one_step_over_persistence, over_persistence
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import RunState
from vjepa2_ac.runs.metrics_log import MetricsLog
from vjepa2_ac.training.step import Run, encode

BEST_BY = "rollout_over_persistence_last"  # checkpoint.keep_best error: planning depends on the longest horizon
RANK = "action_ranking_error"  # checkpoint.keep_best ranking
USED = 0.02  # a model that uses its actions has an error at least this share higher with shuffled actions
RANKING_REACH_CM = 7.5  # half the width of the box of other actions: as far as plans should move in a model step
_AT_ONCE = 64  # samples per batch: as many tokens as the clips of a small micro-batch
_BASE_NOT_CHECKED = (
    "Base compared with persistence: skipped; needs trained input layers, found new ones (the data have other widths"
    " than the base)."
)


def validate_if_due(run: Run, metrics_log: MetricsLog | None, reporter: Reporter) -> bool:
    """Measure and log the validation, if it is due; return whether it is the best so far."""
    step, config = run.state.step, run.config
    if step % config.validation.every != 0 and step != config.training.steps:
        return False
    found = validate(run, reporter)
    is_first = step - config.validation.every < max(1, config.training.warmup_steps) <= step
    if (is_first or step == config.training.steps) and (said := unused_actions(found)):
        reporter.note(said)
    return record(run, found, metrics_log)


def unused_actions(found: Validation) -> str:
    """Return a warning if the model hardly uses the actions; an empty string if it does use them."""
    cost = cost_of_actions(found.errors, "shuffled").value
    if cost >= USED:
        return ""
    return (
        f"Warning: shuffled actions change the one-step error by {cost:+.1%} (expected: at least +{USED:.0%}). The"
        " model ignores its actions and cannot be used for planning. Check the data's axes and stride (`vjepa2-ac data"
        " check`); for training from scratch see docs/encoders.md"
    )


def record(run: Run, found: Validation, metrics_log: MetricsLog | None) -> bool:
    """Log a validation; return whether it is the best so far, by `checkpoint.keep_best`."""
    metrics = validation_metrics(found)
    if metrics_log is not None:
        metrics_log.write("validation", run.state.step, metrics)
        if run.strip is not None:
            with run.accelerator.autocast():
                image = run.strip.draw(run.world_model, run.accelerator.device, run.folder, run.state.step)
            if image is not None:
                metrics_log.show("validation", "imagined", run.state.step, image)
    by, before = run.config.checkpoint.keep_best, run.state
    if by != "off":
        run.state = before.measured(metrics[BEST_BY], metrics[RANK] if by == "ranking" else None)
    return run.state.best_step != before.best_step


def is_done(config: Config, state: RunState) -> bool:
    """Return whether training ends: all steps are done, or `training.patience` validations brought no better one."""
    training = config.training
    if state.step >= training.steps:
        return True
    if training.patience is None or state.best_step is None:
        return False
    return state.step - state.best_step >= training.patience * config.validation.every


def validation_metrics(found: Validation) -> dict[str, Any]:
    """Return the metrics of a validation for the metrics log."""
    errors, by_horizon = found.errors, over_persistence(found.errors, "rollout")
    metrics: dict[str, Any] = {
        "error_over_persistence": one_step_over_persistence(errors).value,
        "error_over_persistence_zero_actions": one_step_over_persistence(errors, "zero").value,
        "error_over_persistence_shuffled_actions": one_step_over_persistence(errors, "shuffled").value,
        "rollout_over_persistence": [r.value for r in by_horizon],
        "rollout_over_persistence_last": by_horizon[-1].value,
    }
    if (ranking := found.ranking) is not None:
        of = {RANK: ranking.rank, f"{RANK}_box": ranking.box, f"{RANK}_shell": ranking.shell}
        for name, one in {**of, "energy_spread": ranking.spread}.items():
            metrics |= {name: one.value, f"{name}_low": one.low, f"{name}_high": one.high}
    return metrics


def validate(run: Run, reporter: Reporter) -> Validation:
    """Measure the held-out clips, and rank the true actions of moves in some of them.

    For the ranking, clips that cannot be read are replaced by other clips, in a fixed order. The processes share the
    clips. The first process computes the result, and all others receive it: results that differ in the last digits
    could otherwise let processes stop at different steps.
    """
    run.world_model.eval()
    with run.accelerator.autocast(), sharing(run.accelerator):
        found = _measured(run)
    found = broadcast_object(run.accelerator, found)
    reporter.validated(run.state.step, found)
    return found


def _measured(run: Run) -> Validation:
    windows = validation_windows(run.dataset, "validation", clips=run.config.validation.clips)
    own = own_part(len(windows), run.config.validation.batch_size)
    read = partial(batches_of, run.dataset, batch_size=run.config.validation.batch_size, may_be_none=True)
    batches, moves = read(windows[own.start : own.stop]), list[RolloutStart]()
    names = [(run.dataset.table.identity(episode), start) for episode, start in windows]
    chosen = {names[place] for place in spread(len(names), run.config.validation.ranking_clips or 0)}
    encoded = _encoded(run, batches, chosen, moves)
    errors = prediction_errors(run.world_model, encoded, before=actions_before(own, windows, read))
    for name, reason in gathered(list(run.dataset.broken.reasons.items())):
        run.dataset.broken.met(name, reason)
    config, space = run.config.validation, run.dataset.spaces.action
    moves = gathered_starts(moves, run.accelerator.device)
    missing = len(chosen) - len({(move.episode_id, move.first_step) for move in moves})
    others = [window for window, name in zip(windows, names, strict=True) if name not in chosen] if missing else []
    for batch in islice(batches_of(run.dataset, others, batch_size=1, may_be_none=True), missing):
        moves += moves_of(encode(run, batch), 0, space, RANKING_REACH_CM / 100)
    if not moves:
        return Validation(errors, None)
    probes = ProbeOptions(samples=config.ranking_samples, reach_cm=RANKING_REACH_CM, at_once=_AT_ONCE)
    return Validation(errors, rank_actions(run.world_model, moves, space, probes, seed=0))


def _encoded(
    run: Run, batches: Iterable[Batch], chosen: Container[tuple[str, int]], moves: list[RolloutStart]
) -> Iterator[LatentBatch]:
    """Yield the latents of batches, and append the moves of the clips that are chosen for the ranking."""
    for batch in batches:
        latents = encode(run, batch)
        if run.strip is not None:
            run.strip.seen(run.dataset, batch, latents)
        for row, name in enumerate(zip(latents.episode_ids, latents.starts, strict=True)):
            if name in chosen:
                moves += moves_of(latents, row, run.dataset.spaces.action, RANKING_REACH_CM / 100)
        yield latents


def validate_base(run: Run, reporter: Reporter) -> Validation | None:
    """Measure a run before its first step, and refuse a base that is no better than copying the last frame.

    Returns None for a run that resumes.

    Raises:
        InputError: The base is not better, and `training.allow_weak_base` is off.
    """
    if run.state.step:
        return None
    reporter.task("measuring the model before the first step")
    found = validate(run, reporter)
    config, error = run.config, one_step_over_persistence(found.errors).value
    if error < 1.0 or config.training.allow_weak_base or config.model.is_random:
        return found
    if run.world_model.fresh_heads is not None:
        reporter.note(_BASE_NOT_CHECKED)
        return found
    said = f"on the validation clips its one-step error is {error:.2f} times that of copying the last frame"
    needed = "a base model that is better than persistence (below 1)"
    fix = "Check the checkpoint, data.stride, data.camera, the order of the state and the gripper's direction;"
    fix += " to adapt it anyway, set training.allow_weak_base=true"
    raise InputError(where="model.base", found=said, needed=needed, fix=fix)
