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

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.evaluation.result import LatentDistribution
from vjepa2_ac.intervals import Estimate, bootstrapped_by_weights

_SCALE = 100.0  # of the MMD


class LatentSums:
    """Sums of one kind of latents over clips: those that one model predicts in a rollout, or the true ones.

    Stored are, by horizon: of each clip the mean over tokens [dim]; the sum over clips [tokens dim] and the sum of
    squared norms, in float64. No clip's latents are stored. A covariance does not depend on where the origin is: norms
    and sums are of the distance to an origin, so they are small; that of the first batch by default. Sums that are
    `joined` have one.
    """

    def __init__(self, origin: Float[Tensor, "horizon tokens_dim"] | None = None) -> None:
        self.episode_ids: list[str] = []
        self._pooled: list[Float[np.ndarray, "batch horizon dim"]] = []
        self._origin = origin
        self._total: Float[Tensor, "horizon tokens_dim"] | float = 0.0
        self._squares: Float[Tensor, " horizon"] | float = 0.0

    def add(self, latents: Float[Tensor, "batch horizon tokens dim"], episode_ids: Sequence[str]) -> None:
        """Add the latents of a batch of clips, in the order of all clips."""
        latents = latents.float()
        flat = latents.flatten(2)
        if self._origin is None:
            self._origin = flat.mean(dim=0).cpu()
        flat = flat - self._origin.to(flat)
        self.episode_ids += episode_ids
        self._pooled.append(latents.mean(dim=2).double().cpu().numpy())
        self._total = self._total + flat.sum(dim=0, dtype=torch.float64).cpu()
        self._squares = self._squares + flat.square().sum(dim=(0, 2), dtype=torch.float64).cpu()

    @classmethod
    def joined(cls, parts: Sequence[LatentSums]) -> LatentSums:
        """Return the sums of all clips of some parts of one origin."""
        whole = cls()
        for part in parts:
            whole.episode_ids += part.episode_ids
            whole._pooled += part._pooled
            whole._total = whole._total + part._total
            whole._squares = whole._squares + part._squares
        return whole

    @property
    def pooled(self) -> Float[np.ndarray, "clips horizon dim"]:
        """The latents of each clip, averaged over tokens."""
        return np.concatenate(self._pooled)

    def variances(self) -> Float[np.ndarray, " horizon"]:
        """Return the trace of the covariance over clips, by horizon; 0 where it is no more than rounding."""
        clips = len(self.episode_ids)
        squares, mean = torch.as_tensor(self._squares / clips), torch.as_tensor(self._total / clips)
        traces = squares - mean.square().sum(dim=1)
        return np.where(traces > 1e-12 * squares, traces, 0.0)

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
        variance=tuple(predicted.variances().tolist()),
        true_variance=tuple(true.variances().tolist()),
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
    """Return the trace of the covariance over clips, predicted over true, by horizon, without intervals.

    It is NaN of one clip.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.where(true.variances() > 0, predicted.variances() / true.variances(), np.nan)
    return tuple(Estimate(value, math.nan, math.nan) for value in values.tolist())


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
