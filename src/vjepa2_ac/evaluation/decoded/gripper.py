"""How far is the gripper closed in an image? A probe on the patch around the fingers, fitted on true frames.

It is told where the fingers are, and sees colours only. Like `hand.py` it is linear: what it reads from a decoded image
is what that image shows at this place.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.evaluation.decoded.ridge import LinearReader, fit_ridge

_SIDE = 96  # pixels, to which images are resized
_PATCH = 20  # pixels of these


class GripperProbe(LinearReader):
    """Reads the closedness of the gripper (0 open, 1 closed) from images of one size."""

    def read(
        self, images: Float[Tensor, "frames 3 size size"], centres: Float[np.ndarray, "frames 2"]
    ) -> Float[np.ndarray, " frames"]:
        """Return closedness; what is read may be beyond 0 .. 1.

        Args:
            images: In 0 .. 1, as the encoder sees them.
            centres: Where the fingers are: x, y in pixels; beyond the image its edge goes on.
        """
        return self.of(_patches(images, centres))[:, 0]


def fit_gripper_probe(
    images: Float[Tensor, "frames 3 size size"],
    centres: Float[np.ndarray, "frames 2"],
    closedness: Float[np.ndarray, " frames"],
    episode_ids: Sequence[str],
) -> GripperProbe:
    """Fit a probe to true frames; frames where a centre is NaN do not count.

    Args:
        images: In 0 .. 1, as the encoder sees them.
        centres: Where the fingers are: x, y in pixels.
        closedness: Of the gripper, as measured.
        episode_ids: Of each frame.

    Raises:
        InputError: Fewer than two episodes show a gripper.
    """
    seen = np.isfinite(centres).all(axis=1)
    targets = np.where(seen, closedness, np.nan)[:, None]
    fit = fit_ridge(_patches(images, np.nan_to_num(centres)), targets, episode_ids)
    return GripperProbe(fit.mean, fit.weights, fit.offset, fit.fitted_on)


def _patches(
    images: Float[Tensor, "frames 3 size size"], centres: Float[np.ndarray, "frames 2"]
) -> Float[Tensor, "frames features"]:
    """Return the colours around the centres, between pixels by bilinear interpolation."""
    middles = torch.from_numpy(np.asarray(centres, dtype=np.float32)) / images.shape[-1] * 2 - 1  # -1 .. 1: the edges
    small = torch.nn.functional.interpolate(images.float().cpu(), size=(_SIDE, _SIDE), mode="area")
    offsets = (torch.arange(_PATCH) - (_PATCH - 1) / 2) / _SIDE * 2
    x = (middles[:, 0, None] + offsets)[:, None, :].expand(-1, _PATCH, -1)
    y = (middles[:, 1, None] + offsets)[:, :, None].expand(-1, -1, _PATCH)
    grid = torch.stack([x, y], dim=-1)
    return torch.nn.functional.grid_sample(small, grid, padding_mode="border", align_corners=False).flatten(1)
