"""Estimates from measured arrays: means and ratios with intervals over episodes, paired between base and run."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from vjepa2_ac.evaluation.intervals import Estimate, bootstrapped, ratio
from vjepa2_ac.evaluation.result import Actions, EpisodeScore, Errors, Evaluation, Metric, Mode, Stratum

Curve = tuple[Estimate, ...]  # at horizon 1, 2, ...; index h - 1


def errors_of(evaluation: Evaluation, name: str, mode: Mode, actions: Actions = "true") -> Errors:
    """Return the errors of a model, or of `persistence`."""
    if name == "persistence":
        return evaluation.persistence.of(mode)
    return evaluation.models[name].with_actions(actions).of(mode)


def mean_error(
    evaluation: Evaluation, name: str, mode: Mode, metric: Metric = "l1", actions: Actions = "true"
) -> Curve:
    """Return the mean error by horizon, of a model or of `persistence`."""
    errors = errors_of(evaluation, name, mode, actions).of(metric)
    return bootstrapped(
        lambda sums: sums[0] / sums[1], np.stack([errors, np.ones_like(errors)]), evaluation.clips.episode_ids
    )


def over_persistence(
    evaluation: Evaluation, name: str, mode: Mode, metric: Metric = "l1", actions: Actions = "true"
) -> Curve:
    """Return mean error over mean persistence error by horizon: 0 perfect, 1 as good as doing nothing."""
    errors = errors_of(evaluation, name, mode, actions).of(metric)
    nothing = evaluation.persistence.of(mode).of(metric)
    return bootstrapped(lambda sums: sums[0] / sums[1], np.stack([errors, nothing]), evaluation.clips.episode_ids)


def one_step_over_persistence(
    evaluation: Evaluation, name: str, metric: Metric = "l1", actions: Actions = "true"
) -> Estimate:
    """Return teacher-forced error over persistence, over all steps of the clips."""
    errors = errors_of(evaluation, name, "teacher_forced", actions).of(metric).mean(axis=1)
    nothing = evaluation.persistence.teacher_forced.of(metric).mean(axis=1)
    return ratio(errors, nothing, evaluation.clips.episode_ids)


def gain_over(evaluation: Evaluation, name: str, other: str, mode: Mode = "rollout", metric: Metric = "l1") -> Curve:
    """Return the share by which a model's error is smaller than another's, by horizon, paired: 0.18 is 18 % better."""
    pair = [errors_of(evaluation, each, mode).of(metric) for each in (name, other)]
    return bootstrapped(lambda sums: 1 - sums[0] / sums[1], np.stack(pair), evaluation.clips.episode_ids)


def difference_to(
    evaluation: Evaluation, name: str, other: str, mode: Mode = "rollout", metric: Metric = "l1"
) -> Curve:
    """Return mean error minus that of another model by horizon, paired by clip: below 0 is better."""
    pair = [errors_of(evaluation, each, mode).of(metric) for each in (name, other)]
    columns = np.stack([pair[0] - pair[1], np.ones_like(pair[0])])
    return bootstrapped(lambda sums: sums[0] / sums[1], columns, evaluation.clips.episode_ids)


def cost_of_actions(evaluation: Evaluation, name: str, actions: Actions, metric: Metric = "l1") -> Estimate:
    """Return the share by which the teacher-forced error grows with zero or shuffled actions, paired; 0: unused."""
    given, true = (errors_of(evaluation, name, "teacher_forced", each).of(metric) for each in (actions, "true"))
    grown = ratio(given.mean(axis=1), true.mean(axis=1), evaluation.clips.episode_ids)
    return Estimate(grown.value - 1, grown.low - 1, grown.high - 1)


def gap_of_actions(evaluation: Evaluation, name: str, actions: Actions, metric: Metric = "l1") -> Estimate:
    """Return how much higher the teacher-forced error over persistence is with zero or shuffled actions, paired."""
    given, true = (errors_of(evaluation, name, "teacher_forced", each).of(metric) for each in (actions, "true"))
    nothing = evaluation.persistence.teacher_forced.of(metric)
    return ratio((given - true).mean(axis=1), nothing.mean(axis=1), evaluation.clips.episode_ids)


def stratum_over_persistence(evaluation: Evaluation, stratum: Stratum, name: str, metric: Metric = "l1") -> Estimate:
    """Return teacher-forced error over persistence of the steps of a stratum; NaN where there are none."""
    return _of_steps(evaluation, stratum, name, "persistence", metric)


def stratum_gain(evaluation: Evaluation, stratum: Stratum, name: str, other: str, metric: Metric = "l1") -> Estimate:
    """Return the share by which the teacher-forced error is smaller than another model's in a stratum, paired."""
    kept = _of_steps(evaluation, stratum, name, other, metric)
    return Estimate(1 - kept.value, 1 - kept.high, 1 - kept.low)


def episode_scores(
    evaluation_ids: tuple[str, ...],
    trained: Float[np.ndarray, " clips"],
    nothing: Float[np.ndarray, " clips"],
    base: Float[np.ndarray, " clips"] | None,
) -> tuple[EpisodeScore, ...]:
    """Return the scores of each episode, best first by error over persistence."""
    names, episode_of = np.unique(np.array(evaluation_ids), return_inverse=True)

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(episode_of, weights=values)

    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = total(trained) / total(nothing)
        gains = None if base is None else 1 - total(trained) / total(base)
    counts = np.bincount(episode_of)
    scores = [
        EpisodeScore(str(name), int(counts[n]), float(ratios[n]), None if gains is None else float(gains[n]))
        for n, name in enumerate(names)
    ]
    return tuple(sorted(scores, key=lambda score: score.over_persistence))


def _of_steps(evaluation: Evaluation, stratum: Stratum, name: str, other: str, metric: Metric) -> Estimate:
    one, two = (
        (errors_of(evaluation, each, "teacher_forced").of(metric) * stratum.steps).sum(axis=1) for each in (name, other)
    )
    return ratio(one, two, evaluation.clips.episode_ids)
