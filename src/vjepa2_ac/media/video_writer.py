"""Video files that every player shows: H.264 in an MP4, written completely or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.storage import atomic_writer
from vjepa2_ac.storage.libraries import require_library

_QUALITY = "20"  # x264's constant rate factor: text stays sharp


def write_video(path: str | Path, frames: Iterable[UInt8[np.ndarray, "height width 3"]], *, rate_hz: float) -> Path:
    """Write RGB frames as a video and return its path; an odd last row or column of pixels is dropped.

    Args:
        path: A local file; missing folders are created.
        frames: Of one size, at least one.
        rate_hz: Frames per second.

    Raises:
        UnreachableError: PyAV is not installed.
        ValueError: No frames, or of different sizes.
    """
    av = video_library()
    size: tuple[int, int] | None = None
    with atomic_writer(path) as file, av.open(file, "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream(
            "libx264", rate=Fraction(rate_hz).limit_denominator(1000), options={"crf": _QUALITY, "preset": "medium"}
        )
        stream.pix_fmt = "yuv420p"  # supported by browsers
        for frame in frames:
            even = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
            if size is None:
                size = even.shape[:2]
                stream.height, stream.width = size
            elif even.shape[:2] != size:
                raise ValueError(f"frames of {size} and {even.shape[:2]} pixels in one video")
            encoded = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            container.mux(stream.encode(encoded))
        if size is None:
            raise ValueError("a video without frames")
        container.mux(stream.encode(None))
    return Path(path)


def video_library() -> Any:
    """Return PyAV.

    Raises:
        UnreachableError: It is not installed.
    """
    return require_library("av", where="video", called="PyAV, which writes videos", extra="video")
