"""Convert camera frames to encoder input: crop, the user's transforms, scaling, normalisation.

The crop and the user's transforms are applied in the loader, to uint8 frames; scaling and normalisation run on the
device, on whole batches.

Source: facebookresearch/vjepa2 @ c2963a4, app/vjepa_droid/transforms.py and src/datasets/utils/video/transforms.py. The
random crop of Meta's training recipe never fits a 16:9 frame, so its fallback, a central crop, is always used, and
nothing is random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.config import DataConfig
from vjepa2_ac.episode import Clip
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import require_decodable_size
from vjepa2_ac.registry import TRANSFORMS

Crop = Literal["released", "square", "letterbox"]
Transform = Callable[[Clip, np.random.Generator], Clip]

NARROWEST, WIDEST = 0.75, 1.35  # aspects (width over height) between these are not cropped in Meta's recipe

_MEAN = (0.485 * 255, 0.456 * 255, 0.406 * 255)  # of ImageNet, with which the encoder was trained
_STD = (0.229 * 255, 0.224 * 255, 0.225 * 255)
_STREAM = 0x7F  # separates the random numbers of transforms from other uses of the same seed and position


@dataclass(frozen=True)
class CropBox:
    """A part of a frame, in pixels."""

    top: int
    left: int
    height: int
    width: int


def crop_box(height: int, width: int, kind: Crop = "released") -> CropBox:
    """Return the part of a frame that the model receives: a central crop limited to an aspect (width over height).

    The limits are 0.75 and 1.35 for `released`, and 1 for `square`, as in Meta's evaluation. `letterbox` is the whole
    frame.
    """
    aspects = {"released": (NARROWEST, WIDEST), "square": (1.0, 1.0), "letterbox": (0.0, float("inf"))}
    narrowest, widest = aspects[kind]
    box_height, box_width = height, width
    if width / height < narrowest:
        box_height = round(width / narrowest)
    elif width / height > widest:
        box_width = round(height * widest)
    return CropBox((height - box_height) // 2, (width - box_width) // 2, box_height, box_width)


def crop_frames(
    frames: UInt8[np.ndarray, "time height width 3"], kind: Crop = "released"
) -> UInt8[np.ndarray, "time crop_height crop_width 3"]:
    """Return the part of the frames that the model receives, at the original resolution; see `DataConfig.crop`.

    The result shares memory with the frames, unless letterbox adds bars.

    Raises:
        InputError: The frames are too large after adding bars.
    """
    if kind == "letterbox":
        return _add_bars(frames)
    box = crop_box(frames.shape[1], frames.shape[2], kind)
    return frames[:, box.top : box.top + box.height, box.left : box.left + box.width]


def split_views(
    frames: UInt8[np.ndarray, "time height all 3"], views: int
) -> UInt8[np.ndarray, "frames height width 3"]:
    """Split frames with several views side by side into single views, in frame-major order.

    Raises:
        InputError: The width of the frames is not a multiple of the number of views.
    """
    time, height, width = frames.shape[:3]
    if width % views:
        needed = f"a multiple of {views}, for {views} views side by side"
        raise InputError(where="planning.views", found=f"an image {width} pixels wide", needed=needed)
    return frames.reshape(time, height, views, -1, 3).swapaxes(1, 2).reshape(time * views, height, -1, 3)


def _add_bars(frames: UInt8[np.ndarray, "time height width 3"]) -> UInt8[np.ndarray, "time side side 3"]:
    height, width = frames.shape[1:3]
    if height == width:
        return frames
    side = max(height, width)
    require_decodable_size(side, side, "data.crop: letterbox", count=len(frames))
    rows, columns = side - height, side - width  # numbers of rows and columns to add
    return np.pad(frames, ((0, 0), (rows // 2, rows - rows // 2), (columns // 2, columns - columns // 2), (0, 0)))


def pixels_to_input(
    frames: UInt8[Tensor, "batch time height width 3"], image_size: int
) -> Float[Tensor, "batch time 3 size size"]:
    """Convert cropped frames to encoder input: resized to a square (bilinear) and normalised as for ImageNet.

    Args:
        frames: Stacked results of `crop_frames`, on any device.
        image_size: Height and width of the result in pixels.
    """
    pixels = frames.flatten(0, 1).permute(0, 3, 1, 2).to(torch.float32)
    resized = torch.nn.functional.interpolate(
        pixels, size=(image_size, image_size), mode="bilinear", align_corners=False, antialias=False
    )
    normalised: Tensor = (resized - channel_constants(_MEAN, frames.device)) / channel_constants(_STD, frames.device)
    return normalised.reshape(*frames.shape[:2], 3, image_size, image_size)


def input_to_pixels(inputs: Float[Tensor, "*batch 3 size size"]) -> UInt8[Tensor, "*batch 3 size size"]:
    """Invert the normalisation of encoder input, and round to uint8 images."""
    pixels = inputs.float() * channel_constants(_STD, inputs.device) + channel_constants(_MEAN, inputs.device)
    return pixels.round().clamp(0, 255).to(torch.uint8)


def to_display_frames(
    frames: UInt8[np.ndarray, "time height width 3"], size: int
) -> UInt8[np.ndarray, "time size size 3"]:
    """Return cropped frames at the resolution of the encoder input, as uint8 images for display."""
    inputs = pixels_to_input(torch.from_numpy(np.ascontiguousarray(frames))[None], size)[0]
    return np.ascontiguousarray(input_to_pixels(inputs).permute(0, 2, 3, 1).numpy())


@dataclass(frozen=True)
class ClipTransforms:
    """The user's transforms of the training clips of a run."""

    transforms: tuple[tuple[str, Transform], ...]  # (name, transform) in the config's order
    seed: int

    @classmethod
    def from_config(cls, data: DataConfig, seed: int) -> ClipTransforms:
        """Create the transforms of a config; called once, in the process that starts the workers."""
        transforms = ((config.name, TRANSFORMS.create(config.name, config.options)) for config in data.transforms)
        return cls(tuple(transforms), seed)

    def apply(self, clip: Clip, position: int) -> Clip:
        """Apply all transforms to a clip: a pure function of the clip, the seed and the position in the run.

        Raises:
            InputError: The result of a transform has other shapes or types.
        """
        for number, (name, transform) in enumerate(self.transforms):
            before, generator = clip, np.random.default_rng([_STREAM, number, self.seed, position])
            clip = transform(before, generator)
            _require_same_shapes(clip, before, name)
        return clip


def _require_same_shapes(result: object, before: Clip, name: str) -> None:
    """Refuse the result of a transform if shapes or types differ from its input; the size of frames may differ."""
    for part in ("frames", "states", "actions"):
        actual, needed = _describe_array(result, part), _describe_array(before, part)
        if actual != needed:
            raise InputError(where=f"data.transforms: {name}", found=actual, needed=needed)


def _describe_array(clip: object, part: str) -> str:
    array = np.asarray(getattr(clip, part, None))
    shape = [str(size) for size in array.shape]
    if part == "frames":
        shape[1:3] = ["height", "width"]
    return f"{part} of {array.dtype}, {' x '.join(shape)}"


@lru_cache(maxsize=32)
def channel_constants(values: tuple[float, float, float], device: torch.device) -> Float[Tensor, "3 1 1"]:
    """Return numbers for red, green and blue as a tensor on a device, cached because copying them blocks the host."""
    with torch.inference_mode(False):  # inference tensors cannot be used in training
        return torch.tensor(values, device=device).view(3, 1, 1)
