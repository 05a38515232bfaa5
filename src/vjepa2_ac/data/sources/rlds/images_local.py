"""Images of one camera in a local record: only the requested ones are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.data.sources.rlds.dataset_info import Shard
from vjepa2_ac.data.sources.rlds.shard_reader import open_shard
from vjepa2_ac.data.sources.rlds.wire_format import Located, NotAnExampleError, Read, locate_items
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.jpeg import decode_jpegs


@dataclass(frozen=True)
class LocalImages:
    """Skips over the images of one camera in a local file, and reads and decodes requested ones."""

    shard: Shard
    feature: Located
    num_steps: int
    where: str  # file, record, identity and feature, for messages

    def __call__(self, steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        """Return the RGB frames at these control steps, in this order.

        Raises:
            InputError: The file has changed, there are too few images, one is not a JPEG, or differs in size.
            ValueError: No steps, or a step outside the episode.
        """
        with open_shard(self.shard) as read:
            return ImagesAt(read, self.feature, self.num_steps, self.where)(steps)


@dataclass(frozen=True)
class ImagesAt:
    """The same for an open file, or a record in memory."""

    read: Read
    feature: Located
    num_steps: int
    where: str

    def __call__(self, steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        """Return the RGB frames at these control steps, in this order.

        Raises:
            InputError: There are too few images, one is not a JPEG, or differs in size.
            ValueError: No steps, or a step outside the episode.
        """
        require_steps(steps, self.num_steps, self.where)
        try:
            offsets, lengths = locate_items(self.read, self.feature, max(steps) + 1)
        except NotAnExampleError as error:
            raise InputError(where=self.where, found=str(error), needed="a list of images") from None
        if len(offsets) <= max(steps):
            raise wrong_count(len(offsets), self.num_steps, self.where)
        return decode_jpegs([self.read(offsets[step], lengths[step]) for step in steps], steps, self.where)


def require_steps(steps: Sequence[int], num_steps: int, where: str) -> None:
    """Refuse steps outside an episode.

    Raises:
        ValueError: No steps, or one outside.
    """
    if not steps or min(steps) < 0 or max(steps) >= num_steps:
        raise ValueError(f"{where}: steps {list(steps)} of {num_steps}")


def wrong_count(found: int, num_steps: int, where: str) -> InputError:
    """Return the error of a camera that has not one image for each step."""
    return InputError(where=where, found=f"{found} images", needed=f"one for each of the {num_steps} steps")
