"""Camera frames to encoder input: crop, augmentation, scaling, normalisation.

The crop is taken in the loader, on uint8; everything else runs on the device, on a whole batch.

Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/transforms.py and src/datasets/utils/video/transforms.py. The
recipe's random crop never fits a 16:9 frame, so its fallback, a central crop, is always taken: nothing is random.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.data.clips.augmentation import jittered, per_channel
from vjepa2_ac.episode import Augmentation

Crop = Literal["released", "square", "letterbox"]

NARROWEST, WIDEST = 0.75, 1.35  # width over height that the recipe leaves uncropped

_MEAN = (0.485 * 255, 0.456 * 255, 0.406 * 255)  # of ImageNet, as the encoder was trained
_STD = (0.229 * 255, 0.224 * 255, 0.225 * 255)


@dataclass(frozen=True)
class CropBox:
    """A part of a frame, in pixels."""

    top: int
    left: int
    height: int
    width: int


def crop_box(height: int, width: int, kind: Crop = "released") -> CropBox:
    """Return the part of a frame that the model sees: all of it, or the centre cut to an aspect (width over height).

    released: an aspect between 0.75 and 1.35. square: 1, as upstream evaluates. letterbox: all.
    """
    aspects = {"released": (NARROWEST, WIDEST), "square": (1.0, 1.0), "letterbox": (0.0, float("inf"))}
    narrowest, widest = aspects[kind]
    box_height, box_width = height, width
    if width / height < narrowest:
        box_height = round(width / narrowest)
    elif width / height > widest:
        box_width = round(height * widest)
    return CropBox((height - box_height) // 2, (width - box_width) // 2, box_height, box_width)


def view(
    frames: UInt8[np.ndarray, "time height width 3"], kind: Crop = "released"
) -> UInt8[np.ndarray, "time seen_height seen_width 3"]:
    """Return the part of the frames that the model sees, at their own resolution; see `DataConfig.crop`.

    A view of the same memory, except for letterbox, if bars must be added.
    """
    if kind == "letterbox":
        return _with_bars(frames)
    box = crop_box(frames.shape[1], frames.shape[2], kind)
    return frames[:, box.top : box.top + box.height, box.left : box.left + box.width]


def _with_bars(frames: UInt8[np.ndarray, "time height width 3"]) -> UInt8[np.ndarray, "time side side 3"]:
    height, width = frames.shape[1:3]
    if height == width:
        return frames
    rows, columns = max(0, width - height), max(0, height - width)  # missing ones, in all
    return np.pad(frames, ((0, 0), (rows // 2, rows - rows // 2), (columns // 2, columns - columns // 2), (0, 0)))


def pixels_to_input(
    frames: UInt8[Tensor, "batch time height width 3"], image_size: int, augmentations: Sequence[Augmentation] = ()
) -> Float[Tensor, "batch time 3 size size"]:
    """Return cropped frames as encoder input: squashed to a square (bilinear), ImageNet mean 0 and std 1.

    Args:
        frames: Results of `view`, stacked, on any device.
        image_size: Height and width of a result, in pixels.
        augmentations: One for each clip, applied before; or none.

    Raises:
        ValueError: There are some augmentations, but not one for each clip.
    """
    batch, time = frames.shape[:2]
    if not augmentations:
        resized = _resized(frames.flatten(0, 1), image_size)
    elif len(augmentations) == batch:
        pairs = zip(frames, augmentations, strict=True)
        resized = torch.cat([_augmented(clip, image_size, augmentation) for clip, augmentation in pairs])
    else:
        raise ValueError(f"{len(augmentations)} augmentations for {batch} clips")
    normalised: Tensor = (resized - per_channel(_MEAN, frames.device)) / per_channel(_STD, frames.device)
    return normalised.reshape(batch, time, 3, image_size, image_size)


def input_to_pixels(inputs: Float[Tensor, "*batch 3 size size"]) -> UInt8[Tensor, "*batch 3 size size"]:
    """Return encoder input as the image that it is, rounded to 8 bits: the inverse of the normalisation."""
    pixels = inputs.float() * per_channel(_STD, inputs.device) + per_channel(_MEAN, inputs.device)
    return pixels.round().clamp(0, 255).to(torch.uint8)


def images_to_input(images: Float[Tensor, "*batch 3 size size"]) -> Float[Tensor, "*batch 3 size size"]:
    """Return images of the encoder's size, black 0 to white 1, as encoder input: with the same normalisation."""
    return (images.float() * 255.0 - per_channel(_MEAN, images.device)) / per_channel(_STD, images.device)


def frames_as_seen(
    frames: UInt8[np.ndarray, "time height width 3"], size: int
) -> UInt8[np.ndarray, "time size size 3"]:
    """Return cropped frames as the encoder sees them, for people to look at."""
    inputs = pixels_to_input(torch.from_numpy(np.ascontiguousarray(frames))[None], size)[0]
    return np.ascontiguousarray(input_to_pixels(inputs).permute(0, 2, 3, 1).numpy())


def frame_of_seen(
    seen: UInt8[np.ndarray, "size size 3"], height: int, width: int, kind: Crop = "released"
) -> UInt8[np.ndarray, "height width 3"]:
    """Return what the encoder sees at its place in a camera frame, for people: white where nothing is seen."""
    box = (
        CropBox(0, 0, max(height, width), max(height, width)) if kind == "letterbox" else crop_box(height, width, kind)
    )
    frame = np.full((height, width, 3), 255, np.uint8)
    part = torch.nn.functional.interpolate(
        torch.tensor(seen).permute(2, 0, 1)[None].float(), size=(box.height, box.width), mode="bilinear"
    )
    pixels = part[0].round().to(torch.uint8).permute(1, 2, 0).numpy()
    if kind == "letterbox":
        top, left = (box.height - height) // 2, (box.width - width) // 2
        return np.ascontiguousarray(pixels[top : top + height, left : left + width])
    frame[box.top : box.top + box.height, box.left : box.left + box.width] = pixels
    return frame


def _augmented(clip: Tensor, image_size: int, augmentation: Augmentation) -> Float[Tensor, "time 3 size size"]:
    top, left, height, width = augmentation.box
    return jittered(_resized(clip[:, top : top + height, left : left + width], image_size), augmentation)


def _resized(frames: UInt8[Tensor, "count height width 3"], size: int) -> Float[Tensor, "count 3 size size"]:
    pixels = frames.permute(0, 3, 1, 2).to(torch.float32)
    return torch.nn.functional.interpolate(
        pixels, size=(size, size), mode="bilinear", align_corners=False, antialias=False
    )
