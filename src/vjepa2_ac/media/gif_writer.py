"""GIF files that every page shows: one palette for all frames, written completely or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from vjepa2_ac.storage import atomic_writer

_COLOURS = 255
_SAMPLED = 4  # every so many-th pixel decides about the palette


def write_gif(
    path: str | Path, frames: Sequence[UInt8[np.ndarray, "height width 3"]], *, seconds: Sequence[float]
) -> Path:
    """Write RGB frames as an endless GIF, and return its path.

    Colours are rounded to 255 without dithering, which would flicker and take several times the room.

    Args:
        path: A local file; missing folders are created.
        frames: Of one size, at least one.
        seconds: How long each is shown; GIFs know hundredths.

    Raises:
        ValueError: No frames, of different sizes, or other than one duration for each.
    """
    if not frames or len({frame.shape for frame in frames}) > 1 or len(seconds) != len(frames):
        raise ValueError(f"{len(frames)} frames of one size, and {len(seconds)} durations")
    sample = np.concatenate([frame[::_SAMPLED, ::_SAMPLED].reshape(-1, 3) for frame in frames])
    palette = Image.fromarray(sample[None]).quantize(_COLOURS)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    milliseconds = [max(20, round(100 * one) * 10) for one in seconds]
    with atomic_writer(path) as file:
        images[0].save(
            file, "GIF", save_all=True, append_images=images[1:], duration=milliseconds, loop=0, optimize=True
        )
    return Path(path)
