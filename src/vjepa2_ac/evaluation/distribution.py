"""Distribution of predicted latents over clips, compared with the true ones: spread, MMD and Fréchet distance.

A prediction that averages possible futures is nearer to each of them and less varied than they are: its error falls,
and a decoded frame is blurred. `spread` is the trace of the covariance over clips of the predicted latents (per token
and number: the mean squared deviation from the mean over clips), over that of the true latents at the same horizon.
1: as varied as the truth; below 1: smoothed. It says nothing about the error: persistence, too, is about 1.

`mmd` is the squared maximum mean discrepancy of features, unbiased over episodes. Its kernel is JEDi's,
k(x, y) = (<x, y> / dim)^2, so it is the squared Frobenius distance of the second moments, over dim^2: it sees means and
covariances, and not a sign that all features share. **The estimate is not JEDi's**: that one counts pairs of a clip
with itself, which favours predictions of less spread when clips are few. Here no pair of clips of one episode counts,
which excludes a prediction and its own truth, too. So the estimate is 0 in expectation if the distributions are equal,
and may be below 0. It is times 100.

`fvd` is the Fréchet distance of FVD, with the frozen encoder's features in place of I3D's: a clip's latents averaged
over tokens and frames. It is biased upwards, the more the fewer clips there are, so it is reported with their number
and with the distance between two halves of the true clips. All three depend on the encoder, the clips, frames and
stride: compare only where these are equal.
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

_SCALE = 100.0  # of the MMD
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

    @property
    def features(self) -> Float[np.ndarray, "clips dim"]:
        """The latents of each clip, averaged over tokens and frames: the features of `frechet_distance`."""
        return np.asarray(self.pooled.mean(axis=1))


def distribution_of(predicted: LatentSums, true: LatentSums) -> LatentDistribution:
    """Return how predicted latents are distributed, compared with the true ones of the same clips."""
    pairs = zip(predicted.pooled.swapaxes(0, 1), true.pooled.swapaxes(0, 1), strict=True)
    return LatentDistribution(
        spread=spread_of(predicted, true),
        mmd=tuple(mmd(one, other, true.episode_ids) for one, other in pairs),
        fvd=frechet_distance(predicted.features, true.features),
        variance=predicted.variances(),
        true_variance=true.variances(),
    )


def frechet_distance(one: Float[np.ndarray, "clips dim"], other: Float[np.ndarray, "others dim"]) -> float:
    """Return |mean - mean'|^2 + tr C + tr C' - 2 tr (C C')^(1/2) of two sets of features; NaN of a single clip.

    With fewer clips than numbers the covariances are singular. The last trace is exact all the same: C = A'A and
    C' = B'B, and it is the sum of the singular values of A B'.

    Source: Dowson and Landau (1982), The Fréchet distance between multivariate normal distributions; as a metric of
    videos, Unterthiner et al. (2018), FVD.
    """
    if min(len(one), len(other)) < 2:
        return math.nan
    means = one.mean(axis=0), other.mean(axis=0)
    left, right = (
        (values - mean) / math.sqrt(len(values) - 1) for values, mean in zip((one, other), means, strict=True)
    )
    common = np.linalg.svd(left @ right.T, compute_uv=False).sum()
    return float(np.square(means[0] - means[1]).sum() + np.square(left).sum() + np.square(right).sum() - 2 * common)


def distance_of_halves(true: LatentSums) -> float:
    """Return the Fréchet distance between the true clips of every second episode and those of the others."""
    _, episode_of = np.unique(np.array(true.episode_ids), return_inverse=True)
    is_even = episode_of % 2 == 0
    return frechet_distance(true.features[is_even], true.features[~is_even])


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


def mmd(
    predicted: Float[np.ndarray, "clips dim"], true: Float[np.ndarray, "clips dim"], episode_ids: Sequence[str]
) -> Estimate:
    """Return the squared maximum mean discrepancy of predicted and true features of the same clips, times 100.

    Near 0 the estimate is degenerate and its interval over episodes too wide. There is none from one episode.

    Source: Gretton et al. (2012), A Kernel Two-Sample Test, lemma 6, with pairs of one episode left out as pairs of one
    sample are there; the kernel: Luo et al. (2410.05203), JEDi.
    """
    one, other = predicted.astype(np.float64), true.astype(np.float64)
    across = _kernel(one, other)
    pairs = _summed(_kernel(one, one) + _kernel(other, other) - across - across.T, episode_ids)
    counts = _summed(np.ones((len(episode_ids), len(episode_ids))), episode_ids)

    def of_weights(weights: np.ndarray) -> np.ndarray:
        return np.asarray(_SCALE * _quadratic(weights, pairs) / _quadratic(weights, counts))[:, None]

    return bootstrapped_by_weights(of_weights, len(pairs))[0]


def _summed(
    kernel: Float[np.ndarray, "clips clips"], episode_ids: Sequence[str]
) -> Float[np.ndarray, "episodes episodes"]:
    """Return the sums over the clips of each pair of episodes, by their sorted names; 0 of an episode with itself."""
    names, episode_of = np.unique(np.array(episode_ids), return_inverse=True)
    member = np.eye(len(names))[episode_of]
    sums = member.T @ kernel @ member
    return np.asarray(sums - np.diag(np.diag(sums)))


def _kernel(
    one: Float[np.ndarray, "clips dim"], other: Float[np.ndarray, "others dim"]
) -> Float[np.ndarray, "clips others"]:
    return np.asarray((one @ other.T / one.shape[1]) ** 2)


def _quadratic(
    weights: Float[np.ndarray, "draws episodes"], matrix: Float[np.ndarray, "episodes episodes"]
) -> Float[np.ndarray, " draws"]:
    """Return w' M w of each draw."""
    return np.asarray(((weights @ matrix) * weights).sum(axis=1))
