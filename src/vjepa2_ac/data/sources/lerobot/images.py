"""The frames of a LeRobot episode: decoded from its part of a video, or from images in the table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.data.cache.block_cached_file import BlockCachedFile
from vjepa2_ac.data.sources.lerobot.parquet import Opener
from vjepa2_ac.errors import InputError
from vjepa2_ac.media import video_reader
from vjepa2_ac.media.image_file import decode_image
from vjepa2_ac.media.image_size import require_bounded


@dataclass(frozen=True)
class VideoFrames:
    """Reads frames of an episode from its part of a video: step k is shown at the part's start + k / fps."""

    open_file: Opener
    path: str
    clock: video_reader.Clock
    num_steps: int
    where: str

    def __call__(self, steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        """Return the RGB frames at these control steps, in this order.

        Raises:
            InputError: The video is missing, damaged, or shows no frame within half a step of the time.
            OSError: It is remote and cannot be read.
            ValueError: No steps, or a step outside the episode.
        """
        _require_within(steps, self.num_steps, self.where)
        opened = self.open_file(self.path)
        try:
            return video_reader.read_frames(opened, steps, where=self.where, clock=self.clock)
        except InputError:
            if isinstance(opened, BlockCachedFile) and opened.failure is not None:
                raise opened.failure from None
            raise


@dataclass(frozen=True)
class StoredImages:
    """Decodes images of an episode from PNG or JPEG in the table; they are read with the first request."""

    read: Callable[[], list[bytes]]
    num_steps: int
    where: str

    def __call__(self, steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        """Return the RGB frames at these control steps, in this order.

        Raises:
            InputError: An image is neither PNG nor JPEG, is damaged, or differs in size from the first.
            OSError: The table is remote and cannot be read.
            ValueError: No steps, or a step outside the episode.
        """
        _require_within(steps, self.num_steps, self.where)
        first = decode_image(self._images[steps[0]], f"{self.where}: step {steps[0]}")
        require_bounded(first.shape[0], first.shape[1], f"{self.where}: step {steps[0]}", count=len(steps))
        others = [decode_image(self._images[step], f"{self.where}: step {step}") for step in steps[1:]]
        frames = [first, *others]
        for step, frame in zip(steps, frames, strict=True):
            if frame.shape != frames[0].shape:
                raise InputError(
                    where=f"{self.where}: step {step}",
                    found=f"an image of {frame.shape[0]}x{frame.shape[1]}",
                    needed=f"{frames[0].shape[0]}x{frames[0].shape[1]} as at step {steps[0]}",
                )
        return np.stack(frames)

    @cached_property
    def _images(self) -> list[bytes]:
        images = self.read()
        if len(images) != self.num_steps:
            raise InputError(
                where=self.where, found=f"{len(images)} images", needed=f"one for each of {self.num_steps} steps"
            )
        return images


def _require_within(steps: Sequence[int], num_steps: int, where: str) -> None:
    if not steps or min(steps) < 0 or max(steps) >= num_steps:
        raise ValueError(f"{where}: steps {list(steps)} of {num_steps}")
