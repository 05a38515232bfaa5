"""Input checks of planning: images and states of a robot are refused if they are invalid."""

from __future__ import annotations

import math

import numpy as np

from vjepa2_ac.episode import EXTRINSICS_DIM, STATE_DIM
from vjepa2_ac.errors import InputError

_LEAST_SIDE = 16  # pixels
_REACH_M = 5.0  # larger positions are not in metres
_ANGLE = 2 * math.pi + 0.01
_GRIPPER_SLACK = 0.1  # a measured closedness may exceed 0 .. 1 by this


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
        raise InputError(
            where=where, found=found, needed=f"an RGB image: height x width x 3, uint8, {_LEAST_SIDE} pixels or more"
        )
    if like is not None and image.shape != like.shape:
        raise InputError(
            where=where,
            found=f"{image.shape[1]} x {image.shape[0]} pixels (width x height)",
            needed=f"{like.shape[1]} x {like.shape[0]}, as the goal image",
            fix="Take both with the same camera, at the same place and resolution",
        )


def require_mask(mask: np.ndarray, *, where: str, like: np.ndarray) -> None:
    """Refuse a mask that is not of an image's size.

    Raises:
        InputError: Says what was found.
    """
    if mask.shape != like.shape[:2]:
        raise InputError(
            where=where,
            found=f"shape {mask.shape} (height, width)",
            needed=f"{like.shape[:2]}, as the goal image",
        )


def require_pose(state: np.ndarray, *, where: str) -> None:
    """Refuse a state that is not a pose in metres and radians with a gripper's closedness.

    Raises:
        InputError: Says what was found.
    """
    needed = f"{STATE_DIM} finite numbers: x, y, z in metres, roll, pitch, yaw in radians, closedness 0 .. 1"
    if state.shape != (STATE_DIM,):
        raise InputError(where=where, found=f"{state.size} numbers in the shape {state.shape}", needed=needed)
    _require_place(state, where, needed)
    if not -_GRIPPER_SLACK <= state[6] <= 1 + _GRIPPER_SLACK:
        raise InputError(where=where, found=f"a closedness of {state[6]:g}", needed=needed, fix=_FROM_WIDTH)


def require_extrinsics(extrinsics: np.ndarray, *, where: str) -> None:
    """Refuse an array that is no camera pose in the robot base frame.

    Raises:
        InputError: Says what was found.
    """
    needed = f"{EXTRINSICS_DIM} finite numbers: the camera's x, y, z in metres and roll, pitch, yaw in radians"
    if extrinsics.shape != (EXTRINSICS_DIM,):
        raise InputError(where=where, found=f"{extrinsics.size} numbers in the shape {extrinsics.shape}", needed=needed)
    _require_place(extrinsics, where, needed)


def _require_place(pose: np.ndarray, where: str, needed: str) -> None:
    shown = ", ".join(f"{number:g}" for number in pose)
    if not np.isfinite(pose).all():
        raise InputError(where=where, found=shown, needed=needed)
    if np.abs(pose[3:6]).max() > _ANGLE:
        raise InputError(where=where, found=f"{shown}: angles beyond a whole turn", needed=needed, fix=_FROM_DEGREES)
    if np.abs(pose[:3]).max() > _REACH_M:
        raise InputError(where=where, found=f"{shown}: beyond {_REACH_M:g} m", needed=needed, fix=_FROM_MILLIMETRES)


_FROM_DEGREES = "These look like degrees: multiply the angles by pi / 180"
_FROM_MILLIMETRES = "These look like millimetres: divide the position by 1000"
_FROM_WIDTH = "Give 0 for open and 1 for closed"
