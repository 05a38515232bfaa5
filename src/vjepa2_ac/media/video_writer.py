"""Films that every player and page shows: H.264 in an MP4, or a GIF; written completely or not at all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.errors import require_library
from vjepa2_ac.storage import atomic_writer

_QUALITY = "20"  # x264's constant rate factor: text stays sharp
_COLOURS = 255  # of a GIF
_SAMPLED = 4  # every so many-th pixel decides about the palette


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
    from PIL import Image

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
