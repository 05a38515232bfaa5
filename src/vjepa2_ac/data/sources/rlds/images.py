"""Images of one camera in a record: only the requested ones are read and decoded."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.data.sources.indexed_source import FramesByStep
from vjepa2_ac.data.sources.rlds.shard_reader import Shard, open_shard
from vjepa2_ac.data.sources.rlds.wire_format import Located, NotAnExampleError, Read, locate_items
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.jpeg import decode_jpegs


def images_in_memory(read: Read, feature: Located, num_steps: int, where: str) -> FramesByStep:
    """Return the reader of the images in a record in memory; `where`: file, record, identity and feature."""
    return FramesByStep(num_steps, where, partial(_decoded, read, feature, num_steps, where))


def images_in_file(shard: Shard, feature: Located, num_steps: int, where: str) -> FramesByStep:
    """Return the reader of the images in a local shard; it skips over those that are not requested."""
    return FramesByStep(num_steps, where, partial(_decoded_from_file, shard, feature, num_steps, where))


def _decoded_from_file(
    shard: Shard, feature: Located, num_steps: int, where: str, steps: Sequence[int]
) -> UInt8[np.ndarray, "time height width 3"]:
    with open_shard(shard) as read:
        return _decoded(read, feature, num_steps, where, steps)


def _decoded(
    read: Read, feature: Located, num_steps: int, where: str, steps: Sequence[int]
) -> UInt8[np.ndarray, "time height width 3"]:
    offsets, lengths = items_of(read, feature, where, max(steps) + 1)
    if len(offsets) <= max(steps):
        raise wrong_count(len(offsets), num_steps, where)
    return decode_jpegs([read(offsets[step], lengths[step]) for step in steps], steps, where)


def items_of(read: Read, feature: Located, where: str, count: int | None = None) -> tuple[list[int], list[int]]:
    """Return offsets and lengths of a camera's images, of the first `count`.

    Raises:
        InputError: The feature is not a list of images.
    """
    try:
        return locate_items(read, feature, count)
    except NotAnExampleError as error:
        raise InputError(where=where, found=str(error), needed="a list of images") from None


def wrong_count(found: int, num_steps: int, where: str) -> InputError:
    """Return the error of a camera that has not one image for each step."""
    return InputError(where=where, found=f"{found} images", needed=f"one for each of the {num_steps} steps")
