"""Images within the page, as data: URLs: PNG for arrays as colours, JPEG for photographs."""

from __future__ import annotations

import base64
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from matplotlib.colors import to_hex

from vjepa2_ac.media.image_file import encode_png
from vjepa2_ac.media.jpeg import encode_jpeg

_JPEG_QUALITIES = (82, 70, 50, 30, 15)
_MOST_PIXELS = 288  # of a photograph along a side

_GREY = (0.5, 0.5, 0.5, 1.0)  # of what is not finite
_STOPS = 12  # of a bar


def colours_of(values: Float[np.ndarray, "height width"], low: float, high: float, colours: str) -> np.ndarray:
    """Return numbers as RGB by one of matplotlib's maps, from `low` to `high`; what is not finite is grey."""
    share = np.ma.masked_invalid((values - low) / max(high - low, 1e-12))
    rgba = colormaps[colours].with_extremes(bad=_GREY)(share.clip(0, 1))
    return np.asarray((255 * rgba[..., :3]).round().astype(np.uint8))


def css_gradient(colours: str) -> str:
    """Return a map of colours as the CSS value of a bar from left (low) to right (high)."""
    stops = [to_hex(colour) for colour in colormaps[colours](np.linspace(0, 1, _STOPS))]
    return f"linear-gradient(to right, {', '.join(stops)})"


def png_url(pixels: UInt8[np.ndarray, "height width channels"]) -> str:
    """Return pixels (RGB or RGBA) as PNG in a data: URL; the same pixels give the same bytes."""
    return _url("png", encode_png(pixels))


def jpeg_urls(
    clips: Sequence[Sequence[UInt8[np.ndarray, "height width 3"]]], *, at_most: int, most_pixels: int = _MOST_PIXELS
) -> list[list[str]]:
    """Return photographs as JPEG in data: URLs, in the best quality in which all of them fit together.

    Args:
        clips: Photographs, clip by clip.
        at_most: Bytes of all URLs together; if the lowest quality needs more, the photographs are left out.
        most_pixels: Of a photograph along a side; larger ones are shrunk.
    """
    small = [[_shrunk(frame, most_pixels) for frame in frames] for frames in clips]
    for quality in _JPEG_QUALITIES:
        urls = [[_url("jpeg", encode_jpeg(frame, quality=quality)) for frame in frames] for frames in small]
        if sum(len(url) for clip in urls for url in clip) <= at_most:
            return urls
    return [[] for _ in clips]


def _shrunk(frame: UInt8[np.ndarray, "height width 3"], most_pixels: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return a photograph of at most this size, by averaging squares of pixels."""
    factor = -(-max(frame.shape[:2]) // most_pixels)
    height, width = (size // factor for size in frame.shape[:2])
    squares = frame[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    return np.asarray(squares.mean(axis=(1, 3)).round().astype(np.uint8))


def _url(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
