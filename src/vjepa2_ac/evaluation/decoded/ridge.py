"""Ridge regression from features of true frames; the ridge is that of the smallest error on left-out episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.errors import InputError

_RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # over the mean squared norm of the features
_FOLDS = 4  # of episodes, among which the ridge is chosen


@dataclass(frozen=True, eq=False)
class LinearReader:
    """Reads numbers from features."""

    mean: Float[Tensor, " features"]
    weights: Float[Tensor, "features targets"]
    offset: Float[Tensor, " targets"]  # the mean of the targets
    fitted_on: tuple[int, int]  # frames, episodes

    def of(self, features: Float[Tensor, "frames features"]) -> Float[np.ndarray, "frames targets"]:
        """Return what the features say."""
        return np.asarray(((features.to(self.mean) - self.mean) @ self.weights + self.offset).numpy())


def fit_ridge(
    features: Float[Tensor, "frames features"],
    targets: Float[np.ndarray, "frames targets"],
    episode_ids: Sequence[str],
) -> LinearReader:
    """Fit targets to features; frames with a target of NaN do not count.

    Args:
        features: In any float type; computed with in float64.
        targets: What is to be read.
        episode_ids: Of each frame.

    Raises:
        InputError: Fewer than two episodes have targets.
    """
    known = np.isfinite(targets).all(axis=1)
    names, fold = np.unique(np.array(episode_ids)[known], return_inverse=True)
    if len(names) < 2:
        raise InputError(
            where="a probe of the hand",
            found=f"{len(names)} episodes of the training split with a hand in the image",
            needed="two, to choose the ridge",
        )
    features = features[torch.from_numpy(known)].double()
    true = torch.from_numpy(targets[known]).double()
    of_fold = torch.from_numpy(fold % min(_FOLDS, len(names)))
    errors = [0.0] * len(_RIDGES)
    for left_out in range(int(of_fold.max()) + 1):
        rest = of_fold != left_out
        for place, (mean, weights, offset) in enumerate(_fits(features[rest], true[rest])):
            read = (features[~rest] - mean) @ weights + offset
            errors[place] += float((read - true[~rest]).norm(dim=1).sum())
    mean, weights, offset = _fits(features, true)[int(np.argmin(errors))]
    return LinearReader(mean, weights, offset, (len(features), len(names)))


def _fits(features: Tensor, true: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return mean, weights and offset for every ridge, from one decomposition."""
    mean, offset = features.mean(dim=0), true.mean(dim=0)
    centred = features - mean
    values, vectors = torch.linalg.eigh(centred @ centred.T)
    inside = vectors.T @ (true - offset)
    scale = values.mean()
    return [
        (mean, centred.T @ (vectors @ (inside / (values.clamp(min=0) + ridge * scale)[:, None])), offset)
        for ridge in _RIDGES
    ]
