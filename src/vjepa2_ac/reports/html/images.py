"""Images within the page, as data: URLs: PNG for arrays as colours, JPEG for photographs."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.media.jpeg import encode_jpeg

_JPEG_QUALITIES = (82, 70, 50, 30, 15)
_MOST_PIXELS = 288  # of a photograph along a side

# A dozen colours of matplotlib's maps of these names (CC0), evenly spaced; between them colours are mixed.
_MAPS = {
    "viridis": (
        "440154 482173 433e85 38588c 2d708e 25858e 1e9b8a 2ab07f 52c569 86d549 c2df23 fde725"
    ),
    "inferno": (
        "000004 140b34 390963 5f136e 85216b a92e5e cb4149 e65d2f f78410 fcae12 f5db4c fcffa4"
    ),
}  # fmt: skip


def colours_of(values: Float[np.ndarray, "height width"], low: float, high: float, colours: str) -> np.ndarray:
    """Return numbers as RGB by a colour map, from `low` to `high`; values that are not finite are grey."""
    table = np.array([list(bytes.fromhex(code)) for code in _MAPS[colours].split()], np.float64)
    share = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    position = np.where(np.isfinite(values), share, 0) * (len(table) - 1)
    mixed = np.stack([np.interp(position, np.arange(len(table)), table[:, c]) for c in range(3)], axis=-1)
    mixed[~np.isfinite(values)] = 128
    return mixed.round().astype(np.uint8)


def css_gradient(colours: str) -> str:
    """Return a colour map as the CSS value of a bar from left (low) to right (high)."""
    return f"linear-gradient(to right, {', '.join('#' + code for code in _MAPS[colours].split())})"


def png_url(pixels: UInt8[np.ndarray, "height width channels"]) -> str:
    """Return pixels (RGB or RGBA) as PNG in a data: URL; the same pixels give the same bytes.

    Source: PNG specification (W3C, third edition), sections 5 and 10.
    """
    height, width, channels = pixels.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, {3: 2, 4: 6}[channels], 0, 0, 0)
    parts = [_chunk(b"IHDR", header), _chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)), _chunk(b"IEND", b"")]
    return _url("png", b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def jpeg_urls(clips: Sequence[Sequence[UInt8[np.ndarray, "height width 3"]]], *, at_most: int) -> list[list[str]]:
    """Return photographs as JPEG in data: URLs, in the best quality in which all of them fit together.

    Args:
        clips: Photographs, clip by clip.
        at_most: Bytes of all URLs together; if the lowest quality needs more, the photographs are left out.
    """
    small = [[_shrunk(frame) for frame in frames] for frames in clips]
    for quality in _JPEG_QUALITIES:
        urls = [[_url("jpeg", encode_jpeg(frame, quality=quality)) for frame in frames] for frames in small]
        if sum(len(url) for clip in urls for url in clip) <= at_most:
            return urls
    return [[] for _ in clips]


def _shrunk(frame: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return a photograph of at most this size, by averaging squares of pixels."""
    factor = -(-max(frame.shape[:2]) // _MOST_PIXELS)
    height, width = (size // factor for size in frame.shape[:2])
    squares = frame[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    return np.asarray(squares.mean(axis=(1, 3)).round().astype(np.uint8))


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def _url(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
