"""Real recordings for tests: H.264 MP4s, and DROID's raw folders with HDF5."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8


def write_mp4(
    path: str | Path,
    frames: Sequence[UInt8[np.ndarray, "height width 3"]],
    *,
    rate: int = 15,
    gop: int = 12,
    b_frames: int = 0,
    codec: str = "libx264",
    times: Sequence[int] | None = None,
    container: Mapping[str, str] | None = None,
    **options: str,
) -> Path:
    """Write pictures as a video of one key frame in `gop`; `times` (in 1/15360 s) makes the spacing uneven."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options=dict(container or {})) as file:
        stream = file.add_stream(codec, rate=rate)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, 15360 if times else rate)
        fast = {"preset": "ultrafast"} if codec == "libx264" else {}
        scenes = {"sc_threshold": "0", "bf": str(b_frames)} if codec == "libx264" else {}
        stream.codec_context.options = fast | scenes | {"g": str(gop)} | options
        stream.codec_context.thread_count = 1
        for number, picture in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts = times[number] if times else number
            frame.time_base = stream.codec_context.time_base
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return Path(path)
