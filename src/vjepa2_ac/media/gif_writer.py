"""Animated GIF files: one palette for all frames, no dithering, looping; written completely or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from vjepa2_ac.storage import atomic_writer

_COLOURS = 255  # and one for "as in the frame before"
_WHITE = 247  # a colour from which it is white
_SAMPLES = 400_000  # pixels from which the palette is computed


def write_gif(
    path: str | Path, frames: Sequence[UInt8[np.ndarray, "height width 3"]], durations_s: Sequence[float]
) -> Path:
    """Write RGB frames as a GIF that repeats for ever, and return its path.

    Identical frames in a row become one that is shown for as long. The same frames give the same bytes.

    Args:
        path: A local file; missing folders are created.
        frames: Of one size, at least one.
        durations_s: How long each is shown, rounded to hundredths of a second; at least 0.02.

    Raises:
        ValueError: No frames, of different sizes, or durations that are too few, too many or too short.
    """
    if not len(frames):
        raise ValueError("a GIF without frames")
    if len(durations_s) != len(frames):
        raise ValueError(f"{len(durations_s)} durations for {len(frames)} frames of a GIF")
    if min(durations_s) < 0.02:
        raise ValueError(f"a frame of a GIF for {min(durations_s)} s; players need at least 0.02 s")
    if len(sizes := {frame.shape for frame in frames}) > 1:
        raise ValueError(f"frames of {' and '.join(map(str, sorted(sizes)))} pixels in one GIF")
    palette = _palette(frames)
    first, *more = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations_ms = [10 * round(100 * duration) for duration in durations_s]
    with atomic_writer(path) as file:
        first.save(file, "GIF", save_all=True, append_images=more, duration=durations_ms, loop=0, optimize=False)
    return Path(path)


def _palette(frames: Sequence[UInt8[np.ndarray, "height width 3"]]) -> Image.Image:
    """Return an image whose palette suits all frames alike: a colour that changed in mid-film would flicker."""
    pixels = np.concatenate([frame.reshape(-1, 3) for frame in frames])
    chosen = pixels[:: len(pixels) // _SAMPLES | 1]  # odd: else only every second column of even frames
    palette = Image.fromarray(chosen[None]).quantize(_COLOURS, method=Image.Quantize.MEDIANCUT, kmeans=1)
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    colours[colours.min(axis=1) >= _WHITE] = 255  # a mean of near-whites would tint the page
    palette.putpalette(colours.ravel().tolist())
    return palette
