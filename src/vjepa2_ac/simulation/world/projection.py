"""Projection: where the hand is in the image of a camera, from its pose alone; nothing is rendered.

Positions in an image are in pixels, x to the right and y down, from the image's upper left *corner*: the middle of the
first pixel is (0.5, 0.5), and an image of twice the size has twice the numbers.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from vjepa2_ac.geometry import matrices_from_euler
from vjepa2_ac.simulation.world.camera import FRAME_SIZE
from vjepa2_ac.simulation.world.domains import Domain

SECOND_CAMERA_TURN_DEG = -100.0
HAND_MIDDLE_M = 0.035
"""Distance of the middle of the hand from the flange, towards the fingers."""
FINGERS_MIDDLE_M = 0.11
"""Distance of the middle of the fingers from the flange."""


def exterior_pose(domain: Domain, camera: str = "exterior_1") -> Float[np.ndarray, "4 4"]:
    """Return the frame of a fixed camera in the world: x right, y down, z into the image.

    Raises:
        ValueError: No such camera.
    """
    turns = {"exterior_1": 0.0, "exterior_2": SECOND_CAMERA_TURN_DEG}
    if camera not in turns:
        raise ValueError(f"no camera {camera!r} that stands still: exterior_1 or exterior_2")
    return domain.camera.turned(turns[camera]).pose()


def hand_pixels(
    states: Float[np.ndarray, "time 7"],
    domain: Domain,
    camera: str = "exterior_1",
    size: tuple[int, int] = FRAME_SIZE,
    *,
    along_m: float = HAND_MIDDLE_M,
) -> Float[np.ndarray, "time 2"]:
    """Return where the middle of the hand is in the image: x, y in pixels (legend: this file's docstring).

    It may be outside of the image, or behind a part of the arm. NaN: behind the camera.

    Args:
        states: Measured, in the robot base frame.
        domain: Their world.
        camera: `exterior_1` or `exterior_2`; the wrist's camera is fixed to the hand.
        size: Height and width of the image.
        along_m: Distance of the point from the flange, towards the fingers.

    Raises:
        ValueError: No such camera.
    """
    hand = states[:, :3] + along_m * matrices_from_euler(states[:, 3:6])[:, :, 2]
    return pixels_of(hand @ domain.base_pose()[:3, :3].T, exterior_pose(domain, camera), domain, size)


def pixels_of(
    points: Float[np.ndarray, "points 3"],
    pose: Float[np.ndarray, "4 4"],
    domain: Domain,
    size: tuple[int, int] = FRAME_SIZE,
) -> Float[np.ndarray, "points 2"]:
    """Return where points of the world (metres) are in the image of a fixed camera at a pose; NaN: behind it."""
    height, width = size
    across, down, ahead = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    focal = height / 2 / np.tan(np.deg2rad(domain.camera.vertical_fov_deg) / 2)
    depth = np.where(ahead > 0, ahead, np.nan)
    return np.stack([width / 2 + focal * across / depth, height / 2 + focal * down / depth], axis=1)
