"""Small frames, enlarged by a whole factor to be looked at."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from PIL import Image


def enlarged(frame: UInt8[np.ndarray, "height width 3"], factor: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return a frame `factor` times as high and wide, smooth (Lanczos); the frame itself where the factor is 1.

    For people only: metrics are computed on the frame itself.

    Raises:
        ValueError: The factor is below 1.
    """
    if factor < 1:
        raise ValueError(f"enlarged by a factor of {factor}")
    if factor == 1:
        return frame
    height, width, _ = frame.shape
    large = Image.fromarray(frame).resize((width * factor, height * factor), Image.Resampling.LANCZOS)
    return np.asarray(large)
