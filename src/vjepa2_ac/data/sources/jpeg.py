"""How do the JPEGs of a camera become pixels, those that are asked for, and pixels a JPEG?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import simplejpeg
from jaxtyping import UInt8

from vjepa2_ac.errors import InputError


@dataclass(frozen=True)
class JpegReader:
    """Decodes the JPEGs of one camera, those that are asked for; equal to TensorFlow's decoder bit for bit."""

    pictures: Sequence[bytes]
    where: str

    def __call__(self, steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        """Return the RGB pictures at these control steps, in this order.

        Raises:
            InputError: A picture is not a JPEG, or differs in size from the first one.
            ValueError: No steps, or a step outside the episode.
        """
        if not steps or min(steps) < 0 or max(steps) >= len(self.pictures):
            raise ValueError(f"{self.where}: steps {list(steps)} of {len(self.pictures)}")
        frames = [self._decode(step) for step in steps]
        for step, frame in zip(steps, frames, strict=True):
            if frame.shape != frames[0].shape:
                raise InputError(
                    where=f"{self.where}: step {step}",
                    found=f"a picture of {frame.shape[0]}x{frame.shape[1]}",
                    needed=f"{frames[0].shape[0]}x{frames[0].shape[1]} as at step {steps[0]}",
                )
        return np.stack(frames)

    def _decode(self, step: int) -> UInt8[np.ndarray, "height width 3"]:
        picture = self.pictures[step]
        try:
            return np.asarray(simplejpeg.decode_jpeg(picture, colorspace="RGB", fastdct=True))
        except ValueError as error:
            raise InputError(
                where=f"{self.where}: step {step}",
                found=f"{len(picture)} bytes that are not a JPEG, starting with {bytes(picture[:4])!r} ({error})",
                needed="a JPEG picture",
            ) from None


def encode_jpeg(frame: UInt8[np.ndarray, "height width 3"], *, quality: int = 95) -> bytes:
    """Return an RGB picture as JPEG; the default quality is TFDS's."""
    return bytes(
        simplejpeg.encode_jpeg(np.ascontiguousarray(frame), quality=quality, colorspace="RGB", colorsubsampling="420")
    )
