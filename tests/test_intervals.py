"""Intervals have their stated coverage, and pairs are resampled together."""

import math

import numpy as np
import pytest
from scipy import stats

from vjepa2_ac.intervals import (
    Estimate,
    bootstrap,
    bootstrap_by_weights,
    estimate_mean,
    estimate_ratio,
    estimate_ratio_difference,
    estimate_share,
)


def test_ratio_weights_clips_by_their_motion() -> None:
    assert estimate_ratio(np.array([1.0, 0.0]), np.array([1.0, 3.0]), ("a", "b")).value == 0.25


@pytest.mark.parametrize("episodes", [6, 30])
def test_interval_coverage_equals_the_stated_rate(episodes: int) -> None:
    """400 simulations: a rate of 95 % is measured to +-1.1 % (one standard deviation); three of these are allowed."""
    rng = np.random.default_rng(0)
    covered = 0
    ids = tuple(str(number) for number in np.repeat(np.arange(episodes), 4))
    for _ in range(400):
        levels = rng.normal(0.7, 0.1, size=episodes)  # episodes differ; clips of one episode are similar
        errors = np.repeat(levels, 4) + rng.normal(0, 0.02, size=4 * episodes)
        columns = np.stack([errors, np.ones(4 * episodes)])[:, :, None]
        (interval,) = bootstrap(lambda sums: sums[0] / sums[1], columns, ids)
        covered += interval.low <= 0.7 <= interval.high
    assert covered / 400 == pytest.approx(0.95, abs=0.035)


def test_shared_episode_difficulty_does_not_widen_the_difference() -> None:
    rng = np.random.default_rng(0)
    hard = rng.normal(1.0, 0.3, size=20)
    ones, ids = np.ones(20), tuple(map(str, range(20)))
    difference = estimate_ratio_difference((hard - 0.1, ones), (hard, ones), ids)
    assert (difference.low, difference.value, difference.high) == pytest.approx((-0.1, -0.1, -0.1))
    assert estimate_ratio(hard, ones, ids).high - estimate_ratio(hard, ones, ids).low > 0.2


def test_interval_level_is_widened_for_few_episodes() -> None:
    """Quantiles of a uniform distribution are their levels: here Phi(-sqrt(n / (n - 1)) t), with Student's t, n - 1."""
    for episodes, student in ((2, 12.7062), (5, 2.77645), (30, 2.04523)):
        (interval,) = bootstrap_by_weights(lambda weights: np.linspace(0, 1, len(weights))[:, None], episodes)
        level = stats.norm.cdf(-math.sqrt(episodes / (episodes - 1)) * student)
        assert (interval.low, interval.high) == pytest.approx((level, 1 - level), rel=1e-3)


def test_bootstrap_draws_whole_episodes() -> None:
    """With two episodes a draw has one of them twice, or both, so the interval spans both values."""
    interval = estimate_mean(np.array([1.0, 1.0, 5.0]), ("a", "a", "b"))
    assert (interval.low, interval.value, interval.high) == pytest.approx((1.0, 7 / 3, 5.0), abs=0.01)


def test_single_episode_has_no_interval_and_nan_is_none_in_json() -> None:
    alone = estimate_mean(np.array([1.0, 2.0]), ("a", "a"))
    assert alone.as_dict() == {"value": 1.5, "low": None, "high": None}
    assert str(alone) == "1.500"
    assert alone.compare_to(0.0) == 0, "nothing is sure"
    assert estimate_ratio(np.zeros(2), np.zeros(2), ("a", "b")).as_dict() == {"value": None, "low": None, "high": None}


def test_compare_to_needs_the_whole_interval_on_one_side() -> None:
    assert Estimate(1.0, 0.5, 1.5).compare_to(1.4) == 0
    assert Estimate(1.0, 0.5, 1.5).compare_to(1.6) == -1
    assert Estimate(1.0, 0.5, 1.5).compare_to(0.4) == 1
    assert Estimate(1.0, math.nan, math.nan).compare_to(0.0) == 0


def test_bootstrap_by_weights_equals_bootstrap_of_sums() -> None:
    rng = np.random.default_rng(3)
    values, ids = rng.random(12), [f"episode {clip % 4}" for clip in range(12)]
    sums = values.reshape(3, 4).sum(axis=0)
    (interval,) = bootstrap_by_weights(lambda weights: (weights @ sums / (3 * weights.sum(axis=1)))[:, None], 4)
    expected = estimate_mean(values, ids)
    assert (interval.value, interval.low, interval.high) == pytest.approx((expected.value, expected.low, expected.high))
    (alone,) = bootstrap_by_weights(lambda weights: weights, 1)
    assert alone.value == 1
    assert not alone.has_interval


def test_published_intervals_are_reproduced() -> None:
    # Brown, Cai, DasGupta (2001) and any table: Wilson's 95 % intervals.
    middle, none, all_of_it = estimate_share(10, 20), estimate_share(0, 20), estimate_share(50, 50)
    assert middle.value == 0.5
    assert (middle.low, middle.high) == pytest.approx((0.2993, 0.7007), abs=1e-4)
    assert (none.value, none.low, none.high) == pytest.approx((0.0, 0.0, 0.1611), abs=1e-4)
    assert (all_of_it.value, all_of_it.low, all_of_it.high) == pytest.approx((1.0, 0.9287, 1.0), abs=1e-4)
