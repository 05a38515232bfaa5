"""The frames of a LeRobot episode: decoded from its part of a video, or from images in the table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.data.sources.indexed_source import FramesByStep
from vjepa2_ac.data.sources.lerobot.parquet import Opener
from vjepa2_ac.errors import InputError
from vjepa2_ac.media import video_reader
from vjepa2_ac.media.image_file import decode_image
from vjepa2_ac.media.image_size import require_bounded
from vjepa2_ac.storage.block_file import BlockCachedFile


def video_frames(open_file: Opener, path: str, clock: video_reader.Clock, num_steps: int, where: str) -> FramesByStep:
    """Return the reader of an episode's part of a video: step k is shown at the part's start + k / fps."""
    return FramesByStep(num_steps, where, partial(_decoded, open_file, path, clock, where))


def _decoded(
    open_file: Opener, path: str, clock: video_reader.Clock, where: str, steps: Sequence[int]
) -> UInt8[np.ndarray, "time height width 3"]:
    opened = open_file(path)
    try:
        return video_reader.read_frames(opened, steps, where=where, clock=clock)
    except InputError:
        if isinstance(opened, BlockCachedFile) and opened.failure is not None:
            raise opened.failure from None
        raise


def stored_images(read: Callable[[], list[bytes]], num_steps: int, where: str) -> FramesByStep:
    """Return the reader of an episode's PNG or JPEG images in the table; they are read with the first request."""

    @cache
    def images() -> list[bytes]:
        found = read()
        if len(found) != num_steps:
            needed = f"one for each of {num_steps} steps"
            raise InputError(where=where, found=f"{len(found)} images", needed=needed)
        return found

    def decode(steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        frames: list[UInt8[np.ndarray, "height width 3"]] = []
        for step in steps:
            at = f"{where}: step {step}"
            frame = decode_image(images()[step], at)
            height, width, _ = frame.shape
            if not frames:
                require_bounded(height, width, at, count=len(steps))
            elif frame.shape != frames[0].shape:
                needed = f"{frames[0].shape[0]}x{frames[0].shape[1]} as at step {steps[0]}"
                raise InputError(where=at, found=f"an image of {height}x{width}", needed=needed)
            frames.append(frame)
        return np.stack(frames)

    return FramesByStep(num_steps, where, decode)
