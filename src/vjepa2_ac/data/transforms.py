"""How does a camera's picture become what the encoder sees? The crop and the scaling of the released recipe.

The crop is a slice, taken in the loader; resize and normalisation run on the device, on a whole batch.

Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/transforms.py and src/datasets/utils/video/transforms.py. The
recipe's random crop never fits a 16:9 frame, so its fallback, a central crop, is always taken: nothing is random.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

NARROWEST, WIDEST = 0.75, 1.35  # width over height that the recipe lets through uncropped

_MEAN = (0.485 * 255, 0.456 * 255, 0.406 * 255)  # of ImageNet, as the encoder was trained
_STD = (0.229 * 255, 0.224 * 255, 0.225 * 255)


@dataclass(frozen=True)
class CropBox:
    """A part of a picture, in pixels."""

    top: int
    left: int
    height: int
    width: int


def crop_box(height: int, width: int) -> CropBox:
    """Return the part of a picture that the model sees: the centre, cut to an aspect between 0.75 and 1.35."""
    box_height, box_width = height, width
    if width / height < NARROWEST:
        box_height = round(width / NARROWEST)
    elif width / height > WIDEST:
        box_width = round(height * WIDEST)
    return CropBox((height - box_height) // 2, (width - box_width) // 2, box_height, box_width)


def crop(frames: UInt8[np.ndarray, "time height width 3"]) -> UInt8[np.ndarray, "time cropped_height cropped_width 3"]:
    """Return the part of the pictures that the model sees, as a view."""
    box = crop_box(*frames.shape[1:3])
    return frames[:, box.top : box.top + box.height, box.left : box.left + box.width]


def pixels_to_input(
    frames: UInt8[Tensor, "batch time height width 3"], image_size: int
) -> Float[Tensor, "batch time 3 size size"]:
    """Return cropped pictures as the encoder wants them: squashed to a square (bilinear), ImageNet mean 0 and std 1."""
    batch, time = frames.shape[:2]
    pixels = frames.flatten(0, 1).permute(0, 3, 1, 2).to(torch.float32)
    resized = torch.nn.functional.interpolate(
        pixels, size=(image_size, image_size), mode="bilinear", align_corners=False, antialias=False
    )
    mean = torch.tensor(_MEAN, device=frames.device).view(3, 1, 1)
    std = torch.tensor(_STD, device=frames.device).view(3, 1, 1)
    normalised: Tensor = (resized - mean) / std
    return normalised.reshape(batch, time, 3, image_size, image_size)
