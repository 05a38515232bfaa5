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
ENOUGH_EPISODES = 5  # with fewer, an interval over episodes means little
_SHARE = 0.95  # probability that an interval covers the true value


@dataclass(frozen=True)
class Estimate:
    """A number with a 95 % bootstrap interval over episodes; NaN where there is one episode only."""

    value: float
    low: float
    high: float

    @property
    def has_interval(self) -> bool:
        """Whether there were enough episodes for an interval."""
        return not math.isnan(self.low)

    def side(self, of: float) -> int:
        """Return -1 or 1 if the whole interval is below or above a number, else 0: uncertain."""
        return -1 if self.high < of else 1 if self.low > of else 0

    def below(self, level: float) -> Estimate:
        """Return how far the number is below a level, with its interval."""
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


def bootstrapped(
    of_sums: Callable[[np.ndarray], np.ndarray],
    columns: Float[np.ndarray, "columns clips metrics"],
    episode_ids: Sequence[str],
) -> tuple[Estimate, ...]:
    """Return an estimate of each metric, which is a function of sums over clips.

    Args:
        of_sums: Turns sums [columns, ..., metrics] into values [..., metrics].
        columns: The summands. All columns are resampled together, so a comparison of two on the same clips is paired.
        episode_ids: Of each clip.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        values = of_sums(columns.sum(axis=1))
        names, episode_of = np.unique(np.array(episode_ids), return_inverse=True)
        count = len(names)
        if count < 2:
            return tuple(Estimate(float(value), math.nan, math.nan) for value in values)
        sums = np.einsum("cnf,ne->cef", columns, np.eye(count)[episode_of], optimize=True)
        drawn = of_sums(np.einsum("re,cef->crf", _draws(count), sums, optimize=True))
    return _estimates(values, drawn, count)


def bootstrapped_by_weights(
    of_weights: Callable[[Float[np.ndarray, "draws episodes"]], Float[np.ndarray, "draws metrics"]],
    episodes: int,
) -> tuple[Estimate, ...]:
    """Return an estimate of each metric that is a function of how often each episode counts, as sums over pairs are.

    Args:
        of_weights: Turns weights of the episodes into values; all weights 1 give the estimate itself.
        episodes: Their number; an interval needs two. The samples are those of `bootstrapped`.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        values = of_weights(np.ones((1, episodes)))[0]
        if episodes < 2:
            return tuple(Estimate(float(value), math.nan, math.nan) for value in values)
        return _estimates(values, of_weights(_draws(episodes)), episodes)


def mean_of(values: Float[np.ndarray, " clips"], episode_ids: Sequence[str]) -> Estimate:
    """Return the mean over clips."""
    return ratio(values, np.ones_like(values), episode_ids)


def ratio(
    errors: Float[np.ndarray, " clips"], others: Float[np.ndarray, " clips"], episode_ids: Sequence[str]
) -> Estimate:
    """Return mean error over mean other error, most often persistence: clips are weighted by the denominator."""
    return ratios(errors[:, None], others[:, None], episode_ids)[0]


def ratios(
    errors: Float[np.ndarray, "clips metrics"], others: Float[np.ndarray, "clips metrics"], episode_ids: Sequence[str]
) -> tuple[Estimate, ...]:
    """Return the `ratio` of each metric."""
    return bootstrapped(lambda sums: sums[0] / sums[1], np.stack([errors, others]), episode_ids)


def ratio_difference(
    one: tuple[Float[np.ndarray, " clips"], Float[np.ndarray, " clips"]],
    other: tuple[Float[np.ndarray, " clips"], Float[np.ndarray, " clips"]],
    episode_ids: Sequence[str],
) -> Estimate:
    """Return the `ratio` of one pair of (errors, persistence) minus that of another on the same clips.

    Both are resampled together, so what makes an episode hard for both does not widen the interval.
    """
    columns = np.stack([*one, *other])[:, :, None]
    return bootstrapped(lambda sums: sums[0] / sums[1] - sums[2] / sums[3], columns, episode_ids)[0]


@lru_cache(maxsize=4)
def _draws(episodes: int) -> Float[np.ndarray, "resamples episodes"]:
    """Return how often each episode was drawn, with replacement, in each bootstrap sample."""
    drawn = np.random.default_rng(0).integers(episodes, size=(RESAMPLES, episodes))
    places = drawn + episodes * np.arange(RESAMPLES)[:, None]
    return np.bincount(places.ravel(), minlength=RESAMPLES * episodes).reshape(RESAMPLES, episodes).astype(np.float64)


def _estimates(
    values: Float[np.ndarray, " metrics"], drawn: Float[np.ndarray, "draws metrics"], episodes: int
) -> tuple[Estimate, ...]:
    from scipy import stats  # takes half a second, which wrong words on a command line do not wait for

    tail = stats.norm.cdf(-math.sqrt(episodes / (episodes - 1)) * stats.t.ppf((1 + _SHARE) / 2, episodes - 1))
    return tuple(
        _with_interval(float(value), column[np.isfinite(column)], float(tail))
        for value, column in zip(values, drawn.T, strict=True)
    )


def _with_interval(value: float, drawn: np.ndarray, tail: float) -> Estimate:
    if not len(drawn) or math.isnan(value):
        return Estimate(value, math.nan, math.nan)
    low, high = np.quantile(drawn, [tail, 1 - tail])
    return Estimate(value, float(low), float(high))


def share_of(successes: int, tries: int) -> Estimate:
    """Return the share of successes with Wilson's 95 % interval, which stays within 0 .. 1.

    Raises:
        ValueError: No trials, or more successes than trials.
    """
    from scipy import stats

    found = stats.binomtest(successes, tries)
    low, high = found.proportion_ci(_SHARE, method="wilson")
    return Estimate(float(found.statistic), float(low), float(high))
