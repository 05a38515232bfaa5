"""Where is the hand in an image? A probe by ridge regression, fitted on true frames and read on any image.

It sees colours only, so what it reads from a decoded image is what that image shows. Positions are in pixels from the
image's upper left corner, x to the right and y down, of the image as the encoder sees it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

HandPositions = Callable[[str, Float[np.ndarray, "time 7"]], Float[np.ndarray, "time 2"]]
"""From the id of an episode and its states to positions in the image; NaN: behind the camera."""

_SIDE = 32  # pixels, to which images are shrunk
_RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # over the mean squared norm of the features
_FOLDS = 4  # of episodes, among which the ridge is chosen


@dataclass(frozen=True, eq=False)
class HandProbe:
    """Reads the position of the hand from images of one size."""

    mean: Float[Tensor, " features"]
    weights: Float[Tensor, "features 2"]
    offset: Float[Tensor, " 2"]  # the mean position
    fitted_on: tuple[int, int]  # frames, episodes

    def read(self, images: Float[Tensor, "*batch 3 size size"]) -> Float[np.ndarray, "*batch 2"]:
        """Return x and y in pixels."""
        flat = _features(images.reshape(-1, *images.shape[-3:])).to(self.mean)
        found = (flat - self.mean) @ self.weights + self.offset
        return np.asarray(found.reshape(*images.shape[:-3], 2).numpy())


def fit_hand_probe(
    images: Float[Tensor, "frames 3 size size"],
    positions: Float[np.ndarray, "frames 2"],
    episode_ids: Sequence[str],
) -> HandProbe:
    """Fit a probe to true frames; the ridge is that of the smallest error on left-out episodes.

    Args:
        images: In 0 .. 1, as the encoder sees them.
        positions: Of the hand; frames with NaN do not count.
        episode_ids: Of each frame.

    Raises:
        ValueError: Fewer than two episodes show a hand.
    """
    known = np.isfinite(positions).all(axis=1)
    names, fold = np.unique(np.array(episode_ids)[known], return_inverse=True)
    if len(names) < 2:
        raise ValueError(f"{len(names)} episodes with a hand in the image; two are needed to choose the ridge")
    features = _features(images)[torch.from_numpy(known)].double()
    true = torch.from_numpy(positions[known]).double()
    of_fold = torch.from_numpy(fold % min(_FOLDS, len(names)))
    errors = [0.0] * len(_RIDGES)
    for left_out in range(int(of_fold.max()) + 1):
        rest = of_fold != left_out
        for place, (mean, weights, offset) in enumerate(_fits(features[rest], true[rest])):
            read = (features[~rest] - mean) @ weights + offset
            errors[place] += float((read - true[~rest]).norm(dim=1).sum())
    mean, weights, offset = _fits(features, true)[int(np.argmin(errors))]
    return HandProbe(mean, weights, offset, (len(features), len(names)))


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


def _features(images: Float[Tensor, "frames 3 size size"]) -> Float[Tensor, "frames features"]:
    small = torch.nn.functional.interpolate(images.float().cpu(), size=(_SIDE, _SIDE), mode="area")
    return small.flatten(1)
