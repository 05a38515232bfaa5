"""Estimates from measured arrays: means and ratios with intervals over episodes, paired between base and run."""

from __future__ import annotations

import numpy as np

from vjepa2_ac.evaluation.result import (
    L1,
    ActionRanking,
    Actions,
    EpisodeScore,
    Landscapes,
    Metric,
    Mode,
    PredictionErrors,
    Stratum,
    Way,
)
from vjepa2_ac.intervals import Estimate, bootstrapped, mean_of, ratio, ratios

Curve = tuple[Estimate, ...]  # at horizon 1, 2, ...; index h - 1


def mean_error(errors: PredictionErrors, mode: Mode, metric: Metric = L1, way: Way = "true") -> Curve:
    """Return the mean error by horizon, of a model or of persistence."""
    found = errors.of(mode, metric, way)
    return ratios(found, np.ones_like(found), errors.episode_ids)


def over_persistence(errors: PredictionErrors, mode: Mode, metric: Metric = L1, way: Way = "true") -> Curve:
    """Return mean error over mean persistence error by horizon: 1 as good as persistence; of L1, 0 is perfect."""
    return ratios(errors.of(mode, metric, way), errors.of(mode, metric, "persistence"), errors.episode_ids)


def one_step_over_persistence(
    errors: PredictionErrors, actions: Actions = "true", stratum: Stratum | None = None
) -> Estimate:
    """Return teacher-forced error over persistence, over all steps of the clips or those of a stratum; NaN of none."""
    return ratio(_one_step(errors, actions, stratum), _one_step(errors, "persistence", stratum), errors.episode_ids)


def gain_over(errors: PredictionErrors, others: PredictionErrors, mode: Mode = "rollout", metric: Metric = L1) -> Curve:
    """Return the share by which a model is better than another, by horizon, paired by clip: 0.18 is 18 % better."""
    pair = [each.of(mode, metric) for each in (errors, others)]
    better = 1 if metric.smaller_is_better else -1
    return bootstrapped(lambda sums: better * (1 - sums[0] / sums[1]), np.stack(pair), errors.episode_ids)


def difference_to(
    errors: PredictionErrors, others: PredictionErrors, mode: Mode = "rollout", metric: Metric = L1
) -> Curve:
    """Return mean error minus that of another model by horizon, paired by clip: of L1, below 0 is better."""
    difference = errors.of(mode, metric) - others.of(mode, metric)
    return ratios(difference, np.ones_like(difference), errors.episode_ids)


def cost_of_actions(errors: PredictionErrors, actions: Actions) -> Estimate:
    """Return the share by which the teacher-forced error grows with zero or shuffled actions, paired; 0: unused."""
    grown = ratio(_one_step(errors, actions), _one_step(errors, "true"), errors.episode_ids)
    return Estimate(grown.value - 1, grown.low - 1, grown.high - 1)


def gap_of_actions(errors: PredictionErrors, actions: Actions) -> Estimate:
    """Return how much higher the teacher-forced error over persistence is with zero or shuffled actions, paired."""
    given, true = (errors.of("teacher_forced", L1, each) for each in (actions, "true"))
    return ratio((given - true).mean(axis=1), _one_step(errors, "persistence"), errors.episode_ids)


def stratum_gain(errors: PredictionErrors, others: PredictionErrors, stratum: Stratum) -> Estimate:
    """Return the share by which the teacher-forced error is smaller than another model's in a stratum, paired."""
    left = ratio(_one_step(errors, "true", stratum), _one_step(others, "true", stratum), errors.episode_ids)
    return left.below(1.0)


def rank_difference(one: ActionRanking, other: ActionRanking) -> Estimate:
    """Return the mean rank of one model minus that of another on the same moves, paired: below 0 is better."""
    return mean_of(one.ranks - other.ranks, one.episode_ids)


def distance_difference(one: Landscapes, other: Landscapes) -> Estimate:
    """Return the mean distance of one model's energy minimum minus that of another on the same clips, paired."""
    distances = np.array([[each.distance for each in found.maps] for found in (one, other)])
    return mean_of(distances[0] - distances[1], [each.episode_id for each in one.maps])


def episode_scores(errors: PredictionErrors, base: PredictionErrors | None) -> tuple[EpisodeScore, ...]:
    """Return the scores of each episode at the last horizon of the rollout, best first by error over persistence."""
    names, episode_of = np.unique(np.array(errors.episode_ids), return_inverse=True)

    def total(of: PredictionErrors, way: Way = "true") -> np.ndarray:
        return np.bincount(episode_of, weights=of.of("rollout", L1, way)[:, -1])

    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = total(errors) / total(errors, "persistence")
        gains = None if base is None else 1 - total(errors) / total(base)
    counts = np.bincount(episode_of)
    scores = [
        EpisodeScore(str(name), int(counts[n]), float(ratios[n]), None if gains is None else float(gains[n]))
        for n, name in enumerate(names)
    ]
    return tuple(sorted(scores, key=lambda score: score.over_persistence))


def _one_step(errors: PredictionErrors, way: Way, stratum: Stratum | None = None) -> np.ndarray:
    """Return the mean teacher-forced L1 error of each clip, or the sum of those in a stratum."""
    found = errors.of("teacher_forced", L1, way)
    return np.asarray(found.mean(axis=1) if stratum is None else (found * stratum.steps).sum(axis=1))
