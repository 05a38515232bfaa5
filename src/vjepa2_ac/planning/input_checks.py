"""Input checks of planning: images and states of a robot are refused if they are invalid."""

from __future__ import annotations

import numpy as np

from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import StateSpace

_LEAST_SIDE = 16  # pixels


def require_image(image: np.ndarray, *, where: str, like: np.ndarray | None = None) -> None:
    """Refuse an array that is no RGB image, or of another size than a given one.

    Args:
        image: The array.
        where: Its name in errors.
        like: An image of the same camera, of the required size.

    Raises:
        InputError: Says what was found.
    """
    found = f"an array of shape {image.shape} and type {image.dtype}"
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or min(image.shape[:2]) < _LEAST_SIDE:
        needed = f"an RGB image: height x width x 3, uint8, {_LEAST_SIDE} pixels or more"
        raise InputError(where=where, found=found, needed=needed)
    if like is not None and image.shape != like.shape:
        found = f"{image.shape[1]} x {image.shape[0]} pixels (width x height)"
        needed = f"{like.shape[1]} x {like.shape[0]}, as the goal image: same camera, place and resolution"
        raise InputError(where=where, found=found, needed=needed)


def require_mask(mask: np.ndarray, *, where: str, like: np.ndarray) -> None:
    """Refuse a mask that is not of an image's size.

    Raises:
        InputError: Says what was found.
    """
    if mask.shape != like.shape[:2]:
        found, needed = f"shape {mask.shape} (height, width)", f"{like.shape[:2]}, as the goal image"
        raise InputError(where=where, found=found, needed=needed)


def require_numbers(numbers: np.ndarray, space: StateSpace, *, where: str) -> None:
    """Refuse an array that is no state of a space, or no camera's pose, or one that no robot has.

    Raises:
        InputError: Says what was found.
    """
    if numbers.shape != (len(space),):
        names = (f"{name} ({unit})" if unit else name for name, unit in zip(space.names, space.units, strict=True))
        found = f"{numbers.size} numbers in the shape {numbers.shape}"
        raise InputError(where=where, found=found, needed=f"{len(space)}: {', '.join(names)}")
    space.require_plausible(numbers[None], where)
