"""Image files as pixels: PNG and JPEG, in RGB."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import simplejpeg
from jaxtyping import UInt8
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from vjepa2_ac.errors import InputError
from vjepa2_ac.media.jpeg import require_bounded
from vjepa2_ac.storage import read_bytes, unreadable

_EIGHT_BIT = {"1", "L", "LA", "P", "RGB", "RGBA"}  # Pillow's modes of at most 8 bits a channel


def read_image(path: str | Path) -> UInt8[np.ndarray, "height width 3"]:
    """Return the RGB pixels of a PNG or JPEG file.

    Raises:
        InputError: There is no such file, it cannot be read, or it is neither PNG nor JPEG.
    """
    try:
        data = read_bytes(path)
    except OSError as error:
        raise unreadable(str(path), error, needed="an image: PNG or JPEG") from None
    return decode_image(data, str(path))


def decode_image(data: bytes, where: str) -> UInt8[np.ndarray, "height width 3"]:
    """Return the RGB pixels of PNG or JPEG bytes; transparency is dropped.

    Raises:
        InputError: They are neither, damaged, too large, or of more than 8 bits a channel.
    """
    try:
        if data.startswith(b"\xff\xd8"):
            height, width, _, _ = simplejpeg.decode_jpeg_header(data)
            require_bounded(height, width, where)
            return np.asarray(simplejpeg.decode_jpeg(data, colorspace="RGB"))
        with PngImageFile(io.BytesIO(data)) as image:  # reads the header only
            require_bounded(image.height, image.width, where)
            return _as_rgb(image)
    except (OSError, ValueError, SyntaxError, struct.error, zlib.error, EOFError, IndexError) as error:
        raise InputError(
            where=where,
            found=f"{len(data)} bytes that are no image, starting with {data[:4]!r} ({error})",
            needed="PNG or JPEG, as a camera's images are stored; depth, as TIFF, is not used",
        ) from None


def _as_rgb(image: Image.Image) -> UInt8[np.ndarray, "height width 3"]:
    if image.mode not in _EIGHT_BIT:
        raise ValueError(f"pixels of the kind {image.mode}, not 8 bits a channel")
    return np.array(image.convert("RGB"))


def encode_png(pixels: UInt8[np.ndarray, "height width channels"]) -> bytes:
    """Return pixels (RGB or RGBA) as PNG."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG", optimize=True)
    return file.getvalue()


def resized(pixels: UInt8[np.ndarray, "height width 3"], side: int) -> UInt8[np.ndarray, "side side 3"]:
    """Return an image at another size, for people: smooth, not the way the encoder resizes."""
    if pixels.shape[:2] == (side, side):
        return pixels
    return np.asarray(Image.fromarray(pixels).resize((side, side), Image.Resampling.LANCZOS))
