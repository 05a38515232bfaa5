"""Image size limit: one bound for all decoders, checked before memory is allocated."""

from __future__ import annotations

from vjepa2_ac.errors import InputError

MOST_PIXELS = 100_000_000  # a robot's camera has a tenth; a file of 600 bytes may claim forty times as many
_MOST_BYTES = 1 << 32  # of images that are decoded together
_MOST_WORK = 2_000_000_000  # pixels of a JPEG times its scans
_SCAN = b"\xff\xda"  # these bytes never occur in a JPEG's data


def require_bounded(height: int, width: int, where: str, *, count: int = 1) -> None:
    """Refuse images that are too large, or too many of that size to be decoded together.

    Args:
        height: Of each, in pixels.
        width: Likewise.
        where: The file, and its episode and step, for messages.
        count: How many are decoded together.

    Raises:
        InputError: They are.
    """
    if height < 1 or width < 1 or height * width > MOST_PIXELS:
        raise InputError(
            where=where,
            found=f"an image of {height} x {width} pixels",
            needed=f"at most {MOST_PIXELS // 1_000_000} megapixels",
            fix="Make the images smaller, or leave the episode out",
        )
    if count * height * width * 3 > _MOST_BYTES:
        raise InputError(
            where=where,
            found=f"{count} images of {height} x {width} pixels at once",
            needed=f"at most {_MOST_BYTES // 10**9} GB of them",
            fix="Make the images smaller, or set data.frames lower",
        )


def require_few_scans(image: bytes, height: int, width: int, where: str) -> None:
    """Refuse a JPEG with too many scans of its pixels: a short file may require days of work.

    Raises:
        InputError: It has.
    """
    scans = bytes(image).count(_SCAN)
    if scans * height * width > _MOST_WORK:
        raise InputError(
            where=where,
            found=f"a JPEG of {height} x {width} pixels in {scans:,} scans",
            needed="one scan, or about ten of a progressive JPEG",
            fix="Write the image again, or leave the episode out",
        )
