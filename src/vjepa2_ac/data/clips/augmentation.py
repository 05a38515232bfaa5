"""Augmentation of training clips: a random crop and colour jitter, drawn once per clip and applied on the device."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config import AugmentConfig
from vjepa2_ac.episode import Augmentation

_STREAM = 0xA6  # separates these random numbers from others of the same seed and position

_BRIGHTNESS = (0.299, 0.587, 0.114)  # weights of red, green and blue, ITU-R BT.601


def draw(config: AugmentConfig, height: int, width: int, *, seed: int, position: int) -> Augmentation | None:
    """Return the augmentation of the clip at a position of the run, or None if there is none.

    A pure function of its arguments: neither workers nor resuming change it. The crop's share of the area is uniform,
    the logarithm of its aspect likewise, among the aspects with which that area fits into the frame; where none of
    `crop_aspect` fits, the nearest one that fits is used. So no draw falls back to the whole frame.

    Args:
        config: The ranges of the changes.
        height: Of the clip's frames, in pixels, after `transforms.view`.
        width: Likewise.
        seed: Of the run.
        position: Of the clip in the run.

    Source: the random resized crop of Szegedy et al. (arXiv 1409.4842, section 6), without its rejections.
    """
    if not config.is_on:
        return None
    numbers = np.random.default_rng([_STREAM, seed, position]).random(7)
    brightness, contrast, saturation = (
        1 + reach * (2 * float(number) - 1)
        for reach, number in zip((config.brightness, config.contrast, config.saturation), numbers[4:], strict=True)
    )
    return Augmentation(_box(config, height, width, numbers), brightness, contrast, saturation)


def _box(
    config: AugmentConfig, height: int, width: int, numbers: Float[np.ndarray, " numbers"]
) -> tuple[int, int, int, int]:
    if config.crop_scale is None:
        return 0, 0, height, width
    least, greatest = config.crop_scale
    share = least + (greatest - least) * float(numbers[0])
    shape = width / height
    fits = share * shape, shape / share  # the narrowest and the widest box of this area
    low, high = (math.log(min(max(aspect, fits[0]), fits[1])) for aspect in config.crop_aspect)
    aspect = math.exp(low + (high - low) * float(numbers[1]))
    area = share * height * width
    box_height = min(height, max(1, round(math.sqrt(area / aspect))))
    box_width = min(width, max(1, round(math.sqrt(area * aspect))))
    top = int(numbers[2] * (height - box_height + 1))
    left = int(numbers[3] * (width - box_width + 1))
    return top, left, box_height, box_width


def jittered(
    pixels: Float[Tensor, "time 3 height width"], augmentation: Augmentation
) -> Float[Tensor, "time 3 height width"]:
    """Return a clip, 0..255, with changed brightness, contrast and saturation; a factor of 1 changes nothing.

    Each blends the frame with another one and clamps: brightness with black, contrast with the mean grey,
    saturation with the frame in grey. The mean grey is the whole clip's, so that every frame changes alike.

    Source: the formulas of torchvision's adjust_brightness, adjust_contrast and adjust_saturation, in this order.
    """
    if augmentation.brightness != 1:
        pixels = _blend(pixels, torch.zeros_like(pixels), augmentation.brightness)
    if augmentation.contrast != 1:
        pixels = _blend(pixels, _grey(pixels).mean(), augmentation.contrast)
    if augmentation.saturation != 1:
        pixels = _blend(pixels, _grey(pixels), augmentation.saturation)
    return pixels


def _blend(pixels: Tensor, plainer: Tensor, factor: float) -> Tensor:
    return (factor * pixels + (1 - factor) * plainer).clamp(0, 255)


def _grey(pixels: Tensor) -> Float[Tensor, "time 1 height width"]:
    return (pixels * per_channel(_BRIGHTNESS, pixels.device)).sum(dim=1, keepdim=True)


@lru_cache(maxsize=32)
def per_channel(values: tuple[float, float, float], device: torch.device) -> Float[Tensor, "3 1 1"]:
    """Return numbers for red, green and blue on a device: copied there once, since the copy blocks the host."""
    with torch.inference_mode(False):  # tensors of inference mode could not be trained with
        return torch.tensor(values, device=device).view(3, 1, 1)
