"""Camera checks: images without contrast, and frames that stay equal although the robot has moved."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import zip_longest

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import StateSpace, rotation_angles

_BLOCKS = 16  # along each side of an image: the mean of a block averages out the noise of a sensor, a scene stays
_LEAST_CONTRAST = 1.0  # of 255: a covered lens with a noise of 10 is below, a scene at 5 % of its light is above
_STILL_M, _STILL_RAD = 0.005, math.radians(3.0)  # measured states of a still arm vary less
_STILL_SHARE = 0.5  # the same for vectors, as a share of the largest change in a model step

CameraFrame = tuple[UInt8[np.ndarray, "height width 3"], Float[np.ndarray, " dim"]]
"""The newest frame of one camera, and the state that was measured when this frame appeared."""


def newest_frames(
    views: Iterable[np.ndarray], state: Float[np.ndarray, " dim"], before: Iterable[CameraFrame]
) -> tuple[CameraFrame, ...]:
    """Return the newest frame of each camera: the earlier one where the pixels are equal.

    Args:
        views: What each camera shows; copied, since a driver may write the next image into the same memory.
        state: Measured.
        before: The newest frames so far; empty after a reset.
    """
    pairs = zip_longest(views, before)
    return tuple(last if last and np.array_equal(last[0], view) else (view.copy(), state) for view, last in pairs)


def has_moved(
    before: Float[np.ndarray, " dim"],
    now: Float[np.ndarray, " dim"],
    space: StateSpace,
    largest: Float[np.ndarray, " dim"],
) -> bool:
    """Return whether two measured states differ by more than the noise of a still robot.

    Args:
        before: The earlier state.
        now: The later state.
        space: The meaning of the numbers.
        largest: The largest change of each number in a model step; used for vectors, whose units are unknown.
    """
    (change,) = space.differences(np.stack([before, now]))
    if not space.is_pose:
        return bool(((largest > 0) & (abs(change) > _STILL_SHARE * largest)).any())
    return float(np.linalg.norm(change[:3])) > _STILL_M or float(rotation_angles(change[None, 3:6])[0]) > _STILL_RAD


def is_uniform(image: UInt8[np.ndarray, "height width 3"]) -> bool:
    """Return whether an image has no contrast: a black, covered or defect camera, with or without noise.

    The standard deviation of the means of 16 x 16 blocks is below 1 of 255 in each colour.
    """
    blocks = Image.fromarray(np.ascontiguousarray(image)).resize((_BLOCKS, _BLOCKS), Image.Resampling.BOX)
    return bool(np.asarray(blocks, dtype=float).std(axis=(0, 1)).max() < _LEAST_CONTRAST)


def require_contrast(views: Iterable[np.ndarray], *, where: str) -> None:
    """Refuse an image if what one of its cameras shows has no contrast.

    Raises:
        InputError: The image is uniform.
    """
    if any(map(is_uniform, views)):
        found, needed = "an image without contrast, as of a black or covered camera", "an image of the scene"
        raise InputError(where=where, found=found, needed=needed)
