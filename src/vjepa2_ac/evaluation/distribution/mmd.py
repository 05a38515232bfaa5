"""Are two sets of features distributed alike? The squared maximum mean discrepancy, unbiased over episodes.

The kernel is JEDi's, k(x, y) = (<x, y> / dim)^2, so the discrepancy is the squared Frobenius distance of the second
moments, over dim^2: it sees means and covariances, and not a sign that all features share. **The estimate is not
JEDi's**: that one counts pairs of a clip with itself, which favours predictions of less spread when clips are few. Here
no pair of clips of one episode counts, which excludes a prediction and its own truth, too. So the estimate is 0 in
expectation if the distributions are equal, and may be below 0.

Everything is times 100, and depends on the encoder, the clips, frames and stride: compare only where these are equal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from vjepa2_ac.intervals import Estimate, bootstrapped_by_weights

FLIPS = 2000  # of signs, for a p-value
HALVINGS = 500  # of the true episodes, for the noise floor
_SCALE = 100.0
_SHARE = 0.95  # of the halvings below the noise floor
_ROUNDING = 1e-9  # flipping all signs gives the same statistic: it counts as equal


@dataclass(frozen=True)
class Discrepancy:
    """The squared MMD of two sets of features, times 100, and whether the sets differ."""

    squared: Estimate  # NaN of one episode
    p_value: float  # of no difference, by sign flips; NaN of one episode

    def as_dict(self) -> dict[str, float | None]:
        """Return plain values, for JSON; None where there is no value."""
        return {**self.squared.as_dict(), "p_value": self.p_value if math.isfinite(self.p_value) else None}


@dataclass(frozen=True)
class EpisodePairs:
    """Sums of kernels over the clips of each pair of episodes: all that the estimates need."""

    both: Float[np.ndarray, "episodes episodes"]  # k(x, x') + k(y, y') - k(x, y') - k(y, x')
    true: Float[np.ndarray, "episodes episodes"]  # k(y, y')
    clips: Int[np.ndarray, " episodes"]  # of each episode

    @property
    def counts(self) -> Float[np.ndarray, "episodes episodes"]:
        """The number of pairs of clips of each pair of episodes; 0 of an episode with itself."""
        return _without_diagonal(np.outer(self.clips, self.clips).astype(np.float64))


def discrepancy(
    predicted: Float[np.ndarray, "clips dim"],
    true: Float[np.ndarray, "clips dim"],
    episode_ids: Sequence[str],
    *,
    seed: int = 0,
) -> Discrepancy:
    """Return the discrepancy of predicted and true features of the same clips, with its interval over episodes.

    The interval is for its size. Whether it differs from 0 is decided by `p_value` alone: near 0 the estimate is
    degenerate, and its interval too wide.

    Args:
        predicted: Row i is of clip i.
        true: Likewise.
        episode_ids: Of each clip.
        seed: Of the bootstrap and of the flips.

    Raises:
        ValueError: The sets differ in shape.

    Source: Gretton et al. (2012), A Kernel Two-Sample Test, lemma 6, with pairs of one episode left out as pairs of one
    sample are there; the kernel: Luo et al. (2410.05203), JEDi.
    """
    pairs = episode_pairs(predicted, true, episode_ids)
    kernel, counts = _without_diagonal(pairs.both), pairs.counts

    def of_weights(weights: np.ndarray) -> np.ndarray:
        return np.asarray(_SCALE * _quadratic(weights, kernel) / _quadratic(weights, counts))[:, None]

    (squared,) = bootstrapped_by_weights(of_weights, len(pairs.clips), seed=seed)
    return Discrepancy(squared, p_of_no_difference(pairs, seed=seed))


def episode_pairs(
    predicted: Float[np.ndarray, "clips dim"], true: Float[np.ndarray, "clips dim"], episode_ids: Sequence[str]
) -> EpisodePairs:
    """Return the sums of kernels over each pair of episodes, in the order of their sorted names.

    Raises:
        ValueError: The sets differ in shape, or in length from the names.
    """
    if predicted.shape != true.shape or len(predicted) != len(episode_ids):
        raise ValueError(f"{predicted.shape} predicted, {true.shape} true features of {len(episode_ids)} clips")
    names, episode_of = np.unique(np.array(episode_ids), return_inverse=True)
    member = np.eye(len(names))[episode_of]
    one, other = predicted.astype(np.float64), true.astype(np.float64)
    of_true, across = _kernel(other, other), _kernel(one, other)
    both = _kernel(one, one) + of_true - across - across.T
    return EpisodePairs(
        member.T @ both @ member, member.T @ of_true @ member, np.bincount(episode_of, minlength=len(names))
    )


def p_of_no_difference(pairs: EpisodePairs, *, flips: int = FLIPS, seed: int = 0) -> float:
    """Return the probability of a discrepancy as large as this one if predictions and truth were exchangeable.

    Each flip exchanges prediction and truth of a random half of the episodes. Of few episodes it cannot be small: at
    least 2 / 2^episodes.
    """
    count = len(pairs.clips)
    if count < 2:
        return math.nan
    kernel = _without_diagonal(pairs.both)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(flips, count))
    least = kernel.sum() - _ROUNDING * np.abs(kernel).sum()
    return float((1 + (_quadratic(signs, kernel) >= least).sum()) / (1 + flips))


def noise_floor(
    true: Float[np.ndarray, "clips dim"], episode_ids: Sequence[str], *, halvings: int = HALVINGS, seed: int = 0
) -> float:
    """Return the discrepancy that two halves of the true episodes stay below in 95 % of random halvings.

    What is smaller cannot be told from the choice of the episodes. It is cautious: halves are smaller than the whole,
    and unlike predictions they are not of the same clips. NaN of fewer than four episodes.
    """
    pairs = episode_pairs(true, true, episode_ids)
    count = len(pairs.clips)
    if count < 4:
        return math.nan
    rng = np.random.default_rng(seed)
    half = np.stack([rng.permutation(count) < count // 2 for _ in range(halvings)]).astype(np.float64)
    kernel, counts, rest = _without_diagonal(pairs.true), pairs.counts, 1 - half
    within = sum(_quadratic(part, kernel) / _quadratic(part, counts) for part in (half, rest))
    across = _quadratic(half, kernel, rest) / _quadratic(half, counts, rest)
    return float(np.quantile(_SCALE * (within - 2 * across), _SHARE))


def _kernel(
    one: Float[np.ndarray, "clips dim"], other: Float[np.ndarray, "others dim"]
) -> Float[np.ndarray, "clips others"]:
    return np.asarray((one @ other.T / one.shape[1]) ** 2)


def _without_diagonal(matrix: Float[np.ndarray, "side side"]) -> Float[np.ndarray, "side side"]:
    return np.asarray(matrix - np.diag(np.diag(matrix)))


def _quadratic(
    left: Float[np.ndarray, "draws side"],
    matrix: Float[np.ndarray, "side side"],
    right: Float[np.ndarray, "draws side"] | None = None,
) -> Float[np.ndarray, " draws"]:
    """Return left' M right of each draw; `right` is `left` if it is None."""
    return np.asarray(((left @ matrix) * (left if right is None else right)).sum(axis=1))
