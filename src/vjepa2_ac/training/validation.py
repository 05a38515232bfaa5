"""Validation of a run on held-out clips, and the check that the base model is better than persistence."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from functools import partial
from itertools import islice
from typing import Any

from vjepa2_ac.config import Config
from vjepa2_ac.data.loader import read_batches, validation_windows
from vjepa2_ac.data.windows import spread_indices
from vjepa2_ac.distributed import broadcast_object, gather_shared, own_share, share_work
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.action_use import Transition, gather_transitions, rank_actions, select_moves
from vjepa2_ac.evaluation.measure import prediction_errors, previous_clip_actions
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import Validation, cost_of_actions, one_step_over_persistence, over_persistence
from vjepa2_ac.evaluation.summary import CHANCE, format_interval, format_percent
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import RunState
from vjepa2_ac.runs.metrics_log import MetricsLog
from vjepa2_ac.training.step import Run, encode

SELECTION_ERROR = (
    "rollout_over_persistence_last"  # for checkpoint.keep_best=error: planning depends on the longest horizon
)
RANKING_ERROR = "action_ranking_error"  # for checkpoint.keep_best=ranking
MIN_ACTION_EFFECT = (
    0.02  # relative increase of the one-step error with shuffled actions, below which a model ignores its actions
)
RANKING_REACH_CM = 7.5  # half the width of the box of alternative actions: the motion of a plan in one model step
_AT_ONCE = 64  # alternative actions per batch, with about the number of tokens of a small micro-batch
_BASE_NOT_CHECKED = (
    "skipped: the check that the base model is better than persistence. It needs trained input projections, and"
    " those for this data are new."
)


def validate_if_due(run: Run, metrics_log: MetricsLog | None, reporter: Reporter) -> bool:
    """Run and log the validation if it is due; return whether the result is the best so far."""
    step, config = run.state.step, run.config
    if step % config.validation.every != 0 and step != config.training.steps:
        return False
    result = validate(run, reporter)
    is_first_after_warmup = step - config.validation.every < max(1, config.training.warmup_steps) <= step
    if (is_first_after_warmup or step == config.training.steps) and (warning := action_warning(result)):
        reporter.note(warning)
    return record(run, result, metrics_log)


def action_warning(validation: Validation) -> str:
    """Return a warning if the predictions hardly depend on the actions, otherwise an empty string."""
    cost = cost_of_actions(validation.errors, "shuffled").value
    if cost >= MIN_ACTION_EFFECT:
        return ""
    consequence = "ignores its actions and cannot be used for planning"
    if (ranking := validation.ranking) is not None and ranking.rank.compare_to(CHANCE) < 0:
        consequence = f"uses its actions little (action-ranking error {_describe_ranking(ranking.rank)})"
    return (
        f"Warning: shuffled actions change the one-step error by {cost:+.1%} (expected: at least"
        f" +{MIN_ACTION_EFFECT:.0%}). The model {consequence}. Check the data's axes and stride (`vjepa2-ac data"
        " check`); for training from scratch see docs/encoders.md"
    )


def base_warning(validation: Validation) -> str:
    """Return a warning if a base model is not shown to rank actions better than chance, otherwise an empty string."""
    ranking = validation.ranking
    if ranking is None or not ranking.rank.has_interval or ranking.rank.is_below(CHANCE):
        return ""
    return (
        "Warning: the base model is not shown to rank actions better than chance (action-ranking error"
        f" {_describe_ranking(ranking.rank)}). Fine-tuning may lower the prediction error without giving a model that"
        " can plan. First check data.camera, data.stride and the axes (`vjepa2-ac data check CONFIG --model BASE`)"
    )


def _describe_ranking(error: Estimate) -> str:
    return f"{format_percent(error.value)} % {format_interval(error)}, chance 50 %"


def record(run: Run, validation: Validation, metrics_log: MetricsLog | None) -> bool:
    """Log a validation; return whether it is the best so far by the criterion `checkpoint.keep_best`."""
    metrics = validation_metrics(validation)
    if metrics_log is not None:
        metrics_log.write("validation", run.state.step, metrics)
        if run.image_strip is not None:
            with run.accelerator.autocast():
                image = run.image_strip.draw(run.world_model, run.accelerator.device, run.folder, run.state.step)
            if image is not None:
                metrics_log.log_image("validation", "imagined", run.state.step, image)
    criterion, before = run.config.checkpoint.keep_best, run.state
    if criterion == "error":
        run.state = before.with_validation(metrics[SELECTION_ERROR])
    elif criterion == "ranking" and _is_candidate(run, metrics):
        run.state = before.with_validation(metrics[SELECTION_ERROR], metrics[RANKING_ERROR])
    return run.state.best_step != before.best_step


def _is_candidate(run: Run, metrics: Mapping[str, float]) -> bool:
    """Return whether `checkpoint.keep_best: ranking` may select the checkpoint of a validation.

    A fine-tuned checkpoint must be shown to rank actions better than chance; otherwise the base model stays selected.
    Without a base model (random weights, new input projections) every checkpoint is a candidate.
    """
    if run.state.step == 0 or not _has_base(run):
        return True
    return Estimate(*(metrics[f"{RANKING_ERROR}{end}"] for end in ("", "_low", "_high"))).is_below(CHANCE)


def _has_base(run: Run) -> bool:
    return not run.config.model.is_random and run.world_model.new_input_projections is None


def is_finished(config: Config, state: RunState) -> bool:
    """Return whether training ends: all steps are done, or the last `training.patience` validations were not better."""
    training = config.training
    if state.step >= training.steps:
        return True
    if training.patience is None or state.best_step is None:
        return False
    return state.step - state.best_step >= training.patience * config.validation.every


def validation_metrics(validation: Validation) -> dict[str, Any]:
    """Return the metrics of a validation for the metrics log."""
    errors, by_horizon = validation.errors, over_persistence(validation.errors, "rollout")
    metrics: dict[str, Any] = {
        "error_over_persistence": one_step_over_persistence(errors).value,
        "error_over_persistence_zero_actions": one_step_over_persistence(errors, "zero").value,
        "error_over_persistence_shuffled_actions": one_step_over_persistence(errors, "shuffled").value,
        "rollout_over_persistence": [r.value for r in by_horizon],
        "rollout_over_persistence_last": by_horizon[-1].value,
    }
    if (ranking := validation.ranking) is not None:
        ranking_errors = {
            RANKING_ERROR: ranking.rank,
            f"{RANKING_ERROR}_box": ranking.box,
            f"{RANKING_ERROR}_shell": ranking.shell,
        }
        for name, estimate in {**ranking_errors, "energy_spread": ranking.spread}.items():
            metrics |= {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}
    return metrics


def validate(run: Run, reporter: Reporter) -> Validation:
    """Measure the prediction errors on held-out clips, and the action-ranking error on some of them.

    In the ranking, clips that cannot be read are replaced by other clips, in a fixed order. The clips are divided
    among the processes. All processes receive the result of the first one: results that differ in the last digits
    could otherwise make processes stop at different steps.
    """
    reporter.task("validating" if run.state.step else "validating the model before the first step")
    run.world_model.eval()
    with run.accelerator.autocast(), share_work(run.accelerator):
        validation = _measure(run)
    validation = broadcast_object(run.accelerator, validation)
    reporter.on_validation(run.state.step, validation)
    return validation


def _measure(run: Run) -> Validation:
    windows = validation_windows(run.dataset, "validation", clips=run.config.validation.clips)
    windows_range = own_share(len(windows), run.config.validation.batch_size)
    read = partial(read_batches, run.dataset, batch_size=run.config.validation.batch_size, allow_empty=True)
    batches, moves = read(windows[windows_range.start : windows_range.stop]), list[Transition]()
    names = [(run.dataset.table.identity(episode), start) for episode, start in windows]
    ranking_clips = {names[index] for index in spread_indices(len(names), run.config.validation.ranking_clips or 0)}
    encoded = _encode_batches(run, batches, ranking_clips, moves)
    errors = prediction_errors(run.world_model, encoded, before=previous_clip_actions(windows_range, windows, read))
    for name, reason in gather_shared(list(run.dataset.broken.reasons.items())):
        run.dataset.broken.record(name, reason)
    config, space = run.config.validation, run.dataset.spaces.action
    moves = gather_transitions(moves, run.accelerator.device)
    missing = len(ranking_clips) - len({(move.episode_id, move.first_step) for move in moves})
    replacements = (
        [window for window, name in zip(windows, names, strict=True) if name not in ranking_clips] if missing else []
    )
    for batch in islice(read_batches(run.dataset, replacements, batch_size=1, allow_empty=True), missing):
        moves += select_moves(encode(run, batch), 0, space, RANKING_REACH_CM / 100)
    if not moves:
        return Validation(errors, None)
    probes = ProbeOptions(samples=config.ranking_samples, reach_cm=RANKING_REACH_CM, at_once=_AT_ONCE)
    return Validation(errors, rank_actions(run.world_model, moves, space, probes, seed=0))


def _encode_batches(
    run: Run, batches: Iterable[Batch], ranking_clips: Container[tuple[str, int]], moves: list[Transition]
) -> Iterator[LatentBatch]:
    """Yield the latents of batches, and append the moving steps of the clips in `ranking_clips` to `moves`."""
    for batch in batches:
        latents = encode(run, batch)
        if run.image_strip is not None:
            run.image_strip.update(run.dataset, batch, latents)
        for index, name in enumerate(zip(latents.episode_ids, latents.starts, strict=True)):
            if name in ranking_clips:
                moves += select_moves(latents, index, run.dataset.spaces.action, RANKING_REACH_CM / 100)
        yield latents


def validate_base(run: Run, reporter: Reporter) -> Validation | None:
    """Validate before the first step, and refuse a base model that is not better than copying the last frame.

    Returns None for a run that resumes.

    Raises:
        InputError: The base model is not better, and `training.allow_weak_base` is off.
    """
    if run.state.step:
        return None
    validation = validate(run, reporter)
    config, error = run.config, one_step_over_persistence(validation.errors).value
    if _has_base(run) and (warning := base_warning(validation)):
        reporter.note(warning)
    if error < 1.0 or config.training.allow_weak_base or config.model.is_random:
        return validation
    if run.world_model.new_input_projections is not None:
        reporter.note(_BASE_NOT_CHECKED)
        return validation
    description = f"on the validation clips its one-step error is {error:.2f} times that of copying the last frame"
    needed = "a base model that is better than persistence (below 1)"
    fix = "Check the checkpoint, data.stride, data.camera, the order of the state and the gripper's direction."
    fix += " To train anyway, set training.allow_weak_base=true"
    raise InputError(where="model.base", found=description, needed=needed, fix=fix)
