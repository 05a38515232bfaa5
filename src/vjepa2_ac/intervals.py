"""Bootstrap intervals: an estimate with its 95 % interval, from resampling whole episodes.

Clips of one episode are correlated: resampling clips would make intervals too narrow. Plain percentiles of the
resampled values are also too narrow with few episodes, so they are widened by the ratio of Student's t to the normal
distribution: with n episodes the interval is from the quantile p to 1 - p of 2000 resampled values, where
p = Phi(-sqrt(n / (n - 1)) t(0.975; n - 1)), Phi is the normal distribution and t the quantile of Student's t. Each
value is computed from n episodes that `numpy.random.default_rng(0).integers(n, size=(2000, n))` draws, as indices into
their sorted names.

Source: Hesterberg (2015), What Teachers Should Know About the Bootstrap, the expanded percentile interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

RESAMPLES = 2000
MIN_EPISODES = 5  # with fewer episodes an interval is unreliable
_CONFIDENCE = 0.95  # probability that an interval covers the true value


@dataclass(frozen=True)
class Estimate:
    """A number with a 95 % bootstrap interval over episodes; the bounds are NaN for a single episode."""

    value: float
    low: float
    high: float

    @property
    def has_interval(self) -> bool:
        """Whether there were enough episodes for an interval."""
        return not math.isnan(self.low)

    def compare_to(self, value: float) -> int:
        """Return -1 or 1 if the whole interval is below or above a number, else 0: uncertain."""
        return -1 if self.high < value else 1 if self.low > value else 0

    def is_below(self, value: float) -> bool:
        """Return whether the whole interval is below a number; without an interval, whether the estimate is below."""
        return (self.high if self.has_interval else self.value) < value

    def subtract_from(self, level: float) -> Estimate:
        """Return `level` minus the estimate, with its interval."""
        return Estimate(level - self.value, level - self.high, level - self.low)

    def as_dict(self) -> dict[str, float | None]:
        """Return plain values, for JSON; None where there is no value or no interval."""
        metrics = {"value": self.value, "low": self.low, "high": self.high}
        return {name: number if math.isfinite(number) else None for name, number in metrics.items()}

    def __format__(self, form: str) -> str:
        """Return the number, and its interval if it has one, each in a number format."""
        value, low, high = (f"{number:{form or '.3f'}}" for number in (self.value, self.low, self.high))
        return f"{value} [{low}, {high}]" if self.has_interval else value

    def __str__(self) -> str:
        return f"{self:.3f}"


def bootstrap(
    compute_metrics: Callable[[np.ndarray], np.ndarray],
    columns: Float[np.ndarray, "columns clips metrics"],
    episode_ids: Sequence[str],
) -> tuple[Estimate, ...]:
    """Return an estimate of each metric, which is a function of sums over clips.

    Args:
        compute_metrics: Computes the metrics [..., metrics] from sums [columns, ..., metrics].
        columns: The summands. All columns are resampled together, so that comparisons on the same clips are paired.
        episode_ids: Episode of each clip.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        values = compute_metrics(columns.sum(axis=1))
        names, episode_of = np.unique(np.array(episode_ids), return_inverse=True)
        count = len(names)
        if count < 2:
            return tuple(Estimate(float(value), math.nan, math.nan) for value in values)
        sums = np.einsum("cnf,ne->cef", columns, np.eye(count)[episode_of], optimize=True)
        drawn = compute_metrics(np.einsum("re,cef->crf", _draw_episode_counts(count), sums, optimize=True))
    return _make_estimates(values, drawn, count)


def bootstrap_by_weights(
    compute_metrics: Callable[[Float[np.ndarray, "draws episodes"]], Float[np.ndarray, "draws metrics"]],
    episodes: int,
) -> tuple[Estimate, ...]:
    """Return an estimate of each metric that is a function of the weights of the episodes, such as sums over pairs.

    Args:
        compute_metrics: Computes the metrics from weights; the weights of the estimate itself are all 1.
        episodes: Number of episodes; an interval needs two. The samples are those of `bootstrap`.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        values = compute_metrics(np.ones((1, episodes)))[0]
        if episodes < 2:
            return tuple(Estimate(float(value), math.nan, math.nan) for value in values)
        return _make_estimates(values, compute_metrics(_draw_episode_counts(episodes)), episodes)


def estimate_mean(values: Float[np.ndarray, " clips"], episode_ids: Sequence[str]) -> Estimate:
    """Return the mean over clips."""
    return estimate_ratio(values, np.ones_like(values), episode_ids)


def estimate_ratio(
    errors: Float[np.ndarray, " clips"], references: Float[np.ndarray, " clips"], episode_ids: Sequence[str]
) -> Estimate:
    """Return the mean error divided by the mean reference error, such as that of persistence.

    Clips are weighted by the denominator.
    """
    return estimate_ratios(errors[:, None], references[:, None], episode_ids)[0]


def estimate_ratios(
    errors: Float[np.ndarray, "clips metrics"],
    references: Float[np.ndarray, "clips metrics"],
    episode_ids: Sequence[str],
) -> tuple[Estimate, ...]:
    """Return the `estimate_ratio` of each metric."""
    return bootstrap(lambda sums: sums[0] / sums[1], np.stack([errors, references]), episode_ids)


def estimate_ratio_difference(
    first: tuple[Float[np.ndarray, " clips"], Float[np.ndarray, " clips"]],
    second: tuple[Float[np.ndarray, " clips"], Float[np.ndarray, " clips"]],
    episode_ids: Sequence[str],
) -> Estimate:
    """Return the ratio of the first pair (errors, persistence) minus that of the second, on the same clips.

    Both are resampled together, so that an episode's difficulty for both does not widen the interval.
    """
    columns = np.stack([*first, *second])[:, :, None]
    return bootstrap(lambda sums: sums[0] / sums[1] - sums[2] / sums[3], columns, episode_ids)[0]


@lru_cache(maxsize=4)
def _draw_episode_counts(episodes: int) -> Float[np.ndarray, "resamples episodes"]:
    """Return how often each episode was drawn, with replacement, in each bootstrap sample."""
    drawn = np.random.default_rng(0).integers(episodes, size=(RESAMPLES, episodes))
    positions = drawn + episodes * np.arange(RESAMPLES)[:, None]
    return (
        np.bincount(positions.ravel(), minlength=RESAMPLES * episodes).reshape(RESAMPLES, episodes).astype(np.float64)
    )


def _make_estimates(
    values: Float[np.ndarray, " metrics"], drawn: Float[np.ndarray, "draws metrics"], episodes: int
) -> tuple[Estimate, ...]:
    from scipy import stats  # imported here because it takes half a second

    tail = stats.norm.cdf(-math.sqrt(episodes / (episodes - 1)) * stats.t.ppf((1 + _CONFIDENCE) / 2, episodes - 1))
    return tuple(
        _make_estimate(float(value), column[np.isfinite(column)], float(tail))
        for value, column in zip(values, drawn.T, strict=True)
    )


def _make_estimate(value: float, drawn: np.ndarray, tail: float) -> Estimate:
    if not len(drawn) or math.isnan(value):
        return Estimate(value, math.nan, math.nan)
    low, high = np.quantile(drawn, [tail, 1 - tail])
    return Estimate(value, float(low), float(high))


def estimate_share(successes: int, trials: int) -> Estimate:
    """Return the share of successes with Wilson's 95 % interval, which stays within 0 .. 1.

    Raises:
        ValueError: No trials, or more successes than trials.
    """
    from scipy import stats

    test = stats.binomtest(successes, trials)
    low, high = test.proportion_ci(_CONFIDENCE, method="wilson")
    return Estimate(float(test.statistic), float(low), float(high))
