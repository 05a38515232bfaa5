"""Are predicted latents as varied as true ones (spread), and distributed alike (MMD)? Streaming sums over clips.

A prediction that averages possible futures is nearer to each of them and less varied than they are: its error falls,
and a decoded frame is blurred. `spread` is the trace of the covariance over clips of the predicted latents (per token
and number: the mean squared deviation from the mean over clips), over that of the true latents at the same horizon.
1: as varied as the truth; below 1: smoothed. It says nothing about the error: persistence, too, is about 1.

`discrepancy` is the squared maximum mean discrepancy of features, unbiased over episodes. Its kernel is JEDi's,
k(x, y) = (<x, y> / dim)^2, so it is the squared Frobenius distance of the second moments, over dim^2: it sees means and
covariances, and not a sign that all features share. **The estimate is not JEDi's**: that one counts pairs of a clip
with itself, which favours predictions of less spread when clips are few. Here no pair of clips of one episode counts,
which excludes a prediction and its own truth, too. So the estimate is 0 in expectation if the distributions are equal,
and may be below 0. Everything is times 100, and depends on the encoder, the clips, frames and stride: compare only
where these are equal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vjepa2_ac.evaluation.result import LatentDistribution
from vjepa2_ac.intervals import Estimate, bootstrapped_by_weights

FLIPS = 2000  # of signs, for a p-value
HALVINGS = 500  # of the true episodes, for the noise floor
_SCALE = 100.0
_SHARE = 0.95  # of the halvings below the noise floor
_ROUNDING = 1e-9  # flipping all signs gives the same statistic: it counts as equal
MOST_SKETCHED = 8192  # numbers of a latent (tokens x dim); of more, a sketch of this length stands in for intervals


class LatentSums:
    """Sums of one kind of latents over clips: those that one model predicts in a rollout, or the true ones.

    Stored are, by horizon: of each clip the mean over tokens [dim] and the squared norm; the sum over clips
    [tokens dim], in float64; and of each episode a sketch of its own sum. No clip's latents are stored: for 7 horizons
    of 256 x 1408 and 250 episodes some 20 MB of sums, 115 MB of sketches, and 0.08 MB a clip. A covariance does not
    depend on where the origin is: norms and sums are of the distance to an origin, so they are small; that of the first
    batch by default. Sums that are `joined` have one.

    The sketch (a count sketch: each number is added, with a random sign, to one of 8,192 random places) preserves the
    inner products of episodes' sums up to about 1 %. Only intervals need them, estimates are exact. Latents of 8,192
    numbers or fewer are stored as they are, and intervals are exact, too.
    """

    def __init__(self, origin: Float[Tensor, "horizon tokens_dim"] | None = None) -> None:
        self.episode_ids: list[str] = []
        self._pooled: list[Float[np.ndarray, "batch horizon dim"]] = []
        self._squares: list[Float[np.ndarray, "batch horizon"]] = []
        self._origin = origin
        self._total: Float[Tensor, "horizon tokens_dim"] | None = None
        self._sketches: dict[str, Float[np.ndarray, "horizon places"]] = {}

    def add(self, latents: Float[Tensor, "batch horizon tokens dim"], episode_ids: Sequence[str]) -> None:
        """Add the latents of a batch of clips, in the order of all clips."""
        latents = latents.float()
        flat = latents.flatten(2)
        if self._origin is None:
            self._origin = flat.mean(dim=0).cpu()
        flat = flat - self._origin.to(flat)
        self.episode_ids += episode_ids
        self._pooled.append(latents.mean(dim=2).double().cpu().numpy())
        self._squares.append(flat.square().sum(dim=2, dtype=torch.float64).cpu().numpy())
        total = flat.sum(dim=0, dtype=torch.float64).cpu()
        self._total = total if self._total is None else self._total + total
        for name, sketch in zip(episode_ids, _sketched(flat).cpu().numpy(), strict=True):
            self._add_sketch(name, sketch)

    @classmethod
    def joined(cls, parts: Sequence[LatentSums]) -> LatentSums:
        """Return the sums of all clips of some parts of one origin."""
        whole = cls()
        whole.episode_ids = [name for part in parts for name in part.episode_ids]
        whole._pooled = [values for part in parts for values in part._pooled]
        whole._squares = [values for part in parts for values in part._squares]
        whole._total = sum(part._total for part in parts if part._total is not None)  # type: ignore[assignment]
        for part in parts:
            for name, sketch in part._sketches.items():
                whole._add_sketch(name, sketch)
        return whole

    def _add_sketch(self, name: str, sketch: Float[np.ndarray, "horizon places"]) -> None:
        self._sketches[name] = self._sketches[name] + sketch if name in self._sketches else sketch

    @property
    def pooled(self) -> Float[np.ndarray, "clips horizon dim"]:
        """The latents of each clip, averaged over tokens."""
        return np.concatenate(self._pooled)

    def variances(self) -> tuple[float, ...]:
        """Return the trace of the covariance over clips, by horizon."""
        assert self._total is not None  # noqa: S101  # there are clips
        clips = len(self.episode_ids)
        traces = self.squares().sum(axis=1) / clips - (self._total / clips).square().sum(dim=1).numpy()
        return tuple(traces.tolist())

    def squares(self) -> Float[np.ndarray, "horizon episodes"]:
        """Return the sum of squared distances of each episode to the origin, in the order of sorted names."""
        names, episode_of = np.unique(np.array(self.episode_ids), return_inverse=True)
        by_clip = np.concatenate(self._squares)
        return np.stack([np.bincount(episode_of, column, len(names)) for column in by_clip.T])

    def products(self) -> Float[np.ndarray, "horizon episodes episodes"]:
        """Return the inner products of the episodes' sums, scaled so that their total is the exact one."""
        assert self._total is not None  # noqa: S101  # there are clips
        sketches = np.stack([self._sketches[name] for name in sorted(self._sketches)], axis=1)
        products = sketches @ sketches.swapaxes(1, 2)
        exact = self._total.square().sum(dim=1).numpy()
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = exact / products.sum(axis=(1, 2))
        return np.asarray(products * np.where(np.isfinite(scale), scale, 1)[:, None, None])


def distribution_of(predicted: LatentSums, true: LatentSums) -> LatentDistribution:
    """Return spread and, averaged over tokens, discrepancy of predicted latents against the true ones of the clips."""
    pairs = zip(predicted.pooled.swapaxes(0, 1), true.pooled.swapaxes(0, 1), strict=True)
    mmd, p_values = zip(*(discrepancy(one, other, true.episode_ids) for one, other in pairs), strict=True)
    return LatentDistribution(spread_of(predicted, true), mmd, p_values, predicted.variances(), true.variances())


def spread_of(predicted: LatentSums, true: LatentSums) -> tuple[Estimate, ...]:
    """Return the trace of the covariance over clips, predicted over true, by horizon; NaN of one clip.

    Both are resampled together, by episodes.
    """
    names, counts = np.unique(np.array(true.episode_ids), return_counts=True)
    sums = [(kind.squares(), kind.products()) for kind in (predicted, true)]

    def of_weights(weights: np.ndarray) -> np.ndarray:
        clips = (weights @ counts)[:, None]
        above, below = (
            weights @ squares.T / clips
            - np.einsum("re,hef,rf->rh", weights, products, weights, optimize=True) / clips**2
            for squares, products in sums
        )
        return np.asarray(above / np.where(below > 1e-12 * (weights @ sums[1][0].T / clips), below, np.nan))

    return bootstrapped_by_weights(of_weights, len(names))


def _sketched(flat: Float[Tensor, "batch horizon numbers"]) -> Float[Tensor, "batch horizon places"]:
    numbers = flat.shape[-1]
    if numbers <= MOST_SKETCHED:
        return flat.double()
    place, sign = _hashes(numbers, flat.device)
    sketch = torch.zeros(*flat.shape[:-1], MOST_SKETCHED, dtype=torch.float64, device=flat.device)
    for row, latents in zip(sketch, flat, strict=True):  # one clip at a time: in float64 a batch would be large
        row.index_add_(-1, place, latents.double() * sign)
    return sketch


@lru_cache(maxsize=2)
def _hashes(numbers: int, device: torch.device) -> tuple[Int[Tensor, " numbers"], Float[Tensor, " numbers"]]:
    """Return the place and the sign of each number: the same for every model and horizon."""
    generator = torch.Generator().manual_seed(0)
    with torch.inference_mode(False):
        place = torch.randint(MOST_SKETCHED, (numbers,), generator=generator)
        sign = torch.randint(2, (numbers,), generator=generator).double() * 2 - 1
        return place.to(device), sign.to(device)


def discrepancy(
    predicted: Float[np.ndarray, "clips dim"], true: Float[np.ndarray, "clips dim"], episode_ids: Sequence[str]
) -> tuple[Estimate, float]:
    """Return the discrepancy of predicted and true features of the same clips, with its interval over episodes.

    The interval is for its size. Whether it differs from 0 is decided by the second number alone, the probability of no
    difference: near 0 the estimate is degenerate, and its interval too wide. Both are NaN of one episode.

    Args:
        predicted: Row i is of clip i.
        true: Likewise.
        episode_ids: Of each clip.

    Source: Gretton et al. (2012), A Kernel Two-Sample Test, lemma 6, with pairs of one episode left out as pairs of one
    sample are there; the kernel: Luo et al. (2410.05203), JEDi.
    """
    pairs, counts = episode_pairs(predicted, true, episode_ids), _counts(episode_ids)

    def of_weights(weights: np.ndarray) -> np.ndarray:
        return np.asarray(_SCALE * _quadratic(weights, pairs) / _quadratic(weights, counts))[:, None]

    (squared,) = bootstrapped_by_weights(of_weights, len(pairs))
    return squared, p_of_no_difference(pairs)


def episode_pairs(
    predicted: Float[np.ndarray, "clips dim"], true: Float[np.ndarray, "clips dim"], episode_ids: Sequence[str]
) -> Float[np.ndarray, "episodes episodes"]:
    """Return k(x, x') + k(y, y') - k(x, y') - k(y, x'), summed over the clips of each pair of episodes."""
    one, other = predicted.astype(np.float64), true.astype(np.float64)
    across = _kernel(one, other)
    return _summed(_kernel(one, one) + _kernel(other, other) - across - across.T, episode_ids)


def _counts(episode_ids: Sequence[str]) -> Float[np.ndarray, "episodes episodes"]:
    return _summed(np.ones((len(episode_ids), len(episode_ids))), episode_ids)


def _summed(
    kernel: Float[np.ndarray, "clips clips"], episode_ids: Sequence[str]
) -> Float[np.ndarray, "episodes episodes"]:
    """Return the sums over the clips of each pair of episodes, by their sorted names; 0 of an episode with itself."""
    names, episode_of = np.unique(np.array(episode_ids), return_inverse=True)
    member = np.eye(len(names))[episode_of]
    sums = member.T @ kernel @ member
    return np.asarray(sums - np.diag(np.diag(sums)))


def p_of_no_difference(kernel: Float[np.ndarray, "episodes episodes"], *, flips: int = FLIPS, seed: int = 0) -> float:
    """Return the probability of a discrepancy as large as this one if predictions and truth were exchangeable.

    The kernel is that of `episode_pairs`. Each flip exchanges prediction and truth of a random half of the
    episodes. Of few episodes it cannot be small: at least 2 / 2^episodes.
    """
    if (count := len(kernel)) < 2:
        return math.nan
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(flips, count))
    least = kernel.sum() - _ROUNDING * np.abs(kernel).sum()
    return float((1 + (_quadratic(signs, kernel) >= least).sum()) / (1 + flips))


def noise_floor(true: Float[np.ndarray, "clips dim"], episode_ids: Sequence[str]) -> float:
    """Return the discrepancy that two halves of the true episodes stay below in 95 % of random halvings.

    What is smaller cannot be told from the choice of the episodes. It is cautious: halves are smaller than the whole,
    and unlike predictions they are not of the same clips. NaN of fewer than four episodes.
    """
    values = true.astype(np.float64)
    kernel, counts = _summed(_kernel(values, values), episode_ids), _counts(episode_ids)
    if (count := len(kernel)) < 4:
        return math.nan
    rng = np.random.default_rng(0)
    half = np.stack([rng.permutation(count) < count // 2 for _ in range(HALVINGS)]).astype(np.float64)
    rest = 1 - half
    within = sum(_quadratic(part, kernel) / _quadratic(part, counts) for part in (half, rest))
    across = _quadratic(half, kernel, rest) / _quadratic(half, counts, rest)
    return float(np.quantile(_SCALE * (within - 2 * across), _SHARE))


def _kernel(
    one: Float[np.ndarray, "clips dim"], other: Float[np.ndarray, "others dim"]
) -> Float[np.ndarray, "clips others"]:
    return np.asarray((one @ other.T / one.shape[1]) ** 2)


def _quadratic(
    left: Float[np.ndarray, "draws side"],
    matrix: Float[np.ndarray, "side side"],
    right: Float[np.ndarray, "draws side"] | None = None,
) -> Float[np.ndarray, " draws"]:
    """Return left' M right of each draw; `right` is `left` if it is None."""
    return np.asarray(((left @ matrix) * (left if right is None else right)).sum(axis=1))
