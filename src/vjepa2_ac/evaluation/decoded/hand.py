"""Where is the hand in an image? A probe by ridge regression, fitted on true frames and read on any image.

It sees colours only, so what it reads from a decoded image is what that image shows. Positions are in pixels from the
image's upper left corner, x to the right and y down, of the image as the encoder sees it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.evaluation.decoded.ridge import LinearReader, fit_ridge

HandPositions = Callable[[str, Float[np.ndarray, "time 7"]], Float[np.ndarray, "time 2"]]
"""From the id of an episode and its states to positions in the image; NaN: behind the camera."""

_SIDE = 32  # pixels, to which images are shrunk


class HandProbe(LinearReader):
    """Reads the position of the hand from images of one size."""

    def read(self, images: Float[Tensor, "*batch 3 size size"]) -> Float[np.ndarray, "*batch 2"]:
        """Return x and y in pixels."""
        found = self.of(_features(images.reshape(-1, *images.shape[-3:])))
        return found.reshape(*images.shape[:-3], 2)


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
        InputError: Fewer than two episodes show a hand.
    """
    fit = fit_ridge(_features(images), positions, episode_ids)
    return HandProbe(fit.mean, fit.weights, fit.offset, fit.fitted_on)


def _features(images: Float[Tensor, "frames 3 size size"]) -> Float[Tensor, "frames features"]:
    small = torch.nn.functional.interpolate(images.float().cpu(), size=(_SIDE, _SIDE), mode="area")
    return small.flatten(1)
