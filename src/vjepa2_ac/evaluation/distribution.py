"""Compare the distributions of predicted and true latents over clips: spread, MMD and Fréchet distance.

A prediction that averages possible futures has a lower error, but it varies less over clips, and the decoded frame is
blurred. `spread` is the trace of the covariance over clips of the predicted latents, divided by that of the true
latents at the same horizon. 1: as varied as the true latents; below 1: smoothed. The spread does not measure the error:
persistence also has a spread of about 1.

`mmd` is the squared maximum mean discrepancy of features, times 100, unbiased over episodes. The kernel is JEDi's,
k(x, y) = (<x, y> / dim)^2. `mmd` is therefore the squared Frobenius distance of the second moments, divided by dim^2.
It depends on means and covariances, but not on a common sign of all features. **The estimator is not JEDi's**, which
counts pairs of a clip with itself and so favours predictions with less spread if there are few clips. Here pairs of
clips from the same episode are excluded, including the pair of a prediction and its true latents. The expectation is 0
if the distributions are equal, and single estimates may be negative.

`fvd` is the Fréchet distance as in FVD, with features of the frozen encoder instead of I3D: the latents of a clip,
averaged over tokens and frames. It is biased upwards, more so with fewer clips. It is therefore reported with the
number of clips and with the distance between two halves of the true clips. All three metrics depend on the encoder, the
clips, the number of frames and the stride: only values for which all of these are equal can be compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.evaluation.result import LatentDistribution
from vjepa2_ac.intervals import Estimate, bootstrap_by_weights

_SCALE = 100.0  # factor of the reported MMD


class LatentSums:
    """Running sums of latents over clips, for the rollouts of one model or for the true latents.

    For each horizon, the mean over tokens of each clip [dim], the sum over clips [tokens dim], and the sum of squared
    norms are stored in float64, but not the latents. An origin (default: the mean of the first batch) is subtracted
    before sums and norms are computed. This keeps the values small and does not change the covariance. Only sums with
    the same origin can be joined.
    """

    def __init__(self, origin: Float[Tensor, "horizon tokens_dim"] | None = None) -> None:
        self.episode_ids: list[str] = []
        self._pooled: list[Float[np.ndarray, "batch horizon dim"]] = []
        self._origin = origin
        self._total: Float[Tensor, "horizon tokens_dim"] | float = 0.0
        self._squares: Float[Tensor, " horizon"] | float = 0.0

    def add(self, latents: Float[Tensor, "batch horizon tokens dim"], episode_ids: Sequence[str]) -> None:
        """Add the latents of a batch of clips."""
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
    def join(cls, parts: Sequence[LatentSums]) -> LatentSums:
        """Return the sums over the clips of all parts, which must have the same origin."""
        joined = cls()
        for part in parts:
            joined.episode_ids += part.episode_ids
            joined._pooled += part._pooled
            joined._total = joined._total + part._total
            joined._squares = joined._squares + part._squares
        return joined

    @property
    def pooled(self) -> Float[np.ndarray, "clips horizon dim"]:
        """The latents of each clip, averaged over tokens."""
        return np.concatenate(self._pooled)

    def variances(self) -> Float[np.ndarray, " horizon"]:
        """Return the trace of the covariance over clips, by horizon; 0 if the trace is within rounding errors."""
        clips = len(self.episode_ids)
        squares, mean = torch.as_tensor(self._squares / clips), torch.as_tensor(self._total / clips)
        traces = squares - mean.square().sum(dim=1)
        return np.where(traces > 1e-12 * squares, traces, 0.0)

    @property
    def features(self) -> Float[np.ndarray, "clips dim"]:
        """The latents of each clip, averaged over tokens and frames: the features of `frechet_distance`."""
        return np.asarray(self.pooled.mean(axis=1))


def compare_distributions(predicted: LatentSums, true: LatentSums) -> LatentDistribution:
    """Compare the distribution of predicted latents with that of the true latents of the same clips."""
    pairs = zip(predicted.pooled.swapaxes(0, 1), true.pooled.swapaxes(0, 1), strict=True)
    return LatentDistribution(
        spread=relative_spread(predicted, true),
        mmd=tuple(mmd(predicted, latents, true.episode_ids) for predicted, latents in pairs),
        fvd=frechet_distance(predicted.features, true.features),
        variance=tuple(predicted.variances().tolist()),
        true_variance=tuple(true.variances().tolist()),
    )


def frechet_distance(first: Float[np.ndarray, "clips dim"], second: Float[np.ndarray, "other_clips dim"]) -> float:
    """Return |mean - mean'|^2 + tr C + tr C' - 2 tr (C C')^(1/2) of two sets of features; NaN for a single clip.

    With C = A'A and C' = B'B the last trace is the sum of the singular values of A B'. This is exact even with fewer
    clips than dimensions, although the covariances are then singular.

    Source: Dowson and Landau (1982), The Fréchet distance between multivariate normal distributions; as a metric of
    videos, Unterthiner et al. (2018), FVD.
    """
    if min(len(first), len(second)) < 2:
        return math.nan
    means = first.mean(axis=0), second.mean(axis=0)
    first_root, second_root = (
        (values - mean) / math.sqrt(len(values) - 1) for values, mean in zip((first, second), means, strict=True)
    )
    common = np.linalg.svd(first_root @ second_root.T, compute_uv=False).sum()
    traces = np.square(first_root).sum() + np.square(second_root).sum()
    return float(np.square(means[0] - means[1]).sum() + traces - 2 * common)


def frechet_distance_of_halves(true: LatentSums) -> float:
    """Return the Fréchet distance between the true clips of every second episode and the remaining true clips."""
    _, episode_of = np.unique(np.array(true.episode_ids), return_inverse=True)
    is_even = episode_of % 2 == 0
    return frechet_distance(true.features[is_even], true.features[~is_even])


def relative_spread(predicted: LatentSums, true: LatentSums) -> tuple[Estimate, ...]:
    """Return the spread at each horizon, without intervals: the trace of the covariance, predicted divided by true.

    The values are NaN for a single clip.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.where(true.variances() > 0, predicted.variances() / true.variances(), np.nan)
    return tuple(Estimate(value, math.nan, math.nan) for value in values.tolist())


def mmd(
    predicted: Float[np.ndarray, "clips dim"], true: Float[np.ndarray, "clips dim"], episode_ids: Sequence[str]
) -> Estimate:
    """Return the squared maximum mean discrepancy of predicted and true features of the same clips, times 100.

    If the distributions are equal, the estimator is degenerate and its interval is too wide. The value is NaN for a
    single episode.

    Source of the estimator: Gretton et al. (2012), A Kernel Two-Sample Test, lemma 6. It excludes pairs of a sample
    with itself; here all pairs within an episode are excluded. Source of the kernel: Luo et al. (2410.05203), JEDi.
    """
    predicted, true = predicted.astype(np.float64), true.astype(np.float64)
    across = _kernel(predicted, true)
    pairs = _sum_by_episode(_kernel(predicted, predicted) + _kernel(true, true) - across - across.T, episode_ids)
    counts = _sum_by_episode(np.ones((len(episode_ids), len(episode_ids))), episode_ids)

    def compute_mmd(weights: np.ndarray) -> np.ndarray:
        return np.asarray(_SCALE * _quadratic_form(weights, pairs) / _quadratic_form(weights, counts))[:, None]

    return bootstrap_by_weights(compute_mmd, len(pairs))[0]


def _sum_by_episode(
    kernel: Float[np.ndarray, "clips clips"], episode_ids: Sequence[str]
) -> Float[np.ndarray, "episodes episodes"]:
    """Return the sum of the kernel over the clips of each pair of different episodes; 0 on the diagonal."""
    names, episode_of = np.unique(np.array(episode_ids), return_inverse=True)
    member = np.eye(len(names))[episode_of]
    sums = member.T @ kernel @ member
    return np.asarray(sums - np.diag(np.diag(sums)))


def _kernel(
    first: Float[np.ndarray, "clips dim"], second: Float[np.ndarray, "other_clips dim"]
) -> Float[np.ndarray, "clips other_clips"]:
    return np.asarray((first @ second.T / first.shape[1]) ** 2)


def _quadratic_form(
    weights: Float[np.ndarray, "draws episodes"], matrix: Float[np.ndarray, "episodes episodes"]
) -> Float[np.ndarray, " draws"]:
    """Return w' M w for each draw."""
    return np.asarray(((weights @ matrix) * weights).sum(axis=1))
