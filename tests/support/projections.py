"""Where a point is in the image of a simulated arm's camera, by what the arm reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vjepa2_ac.spaces import matrices_from_euler

if TYPE_CHECKING:
    from vjepa2_ac.simulation.arm import SimulatedArm

HAND_MIDDLE_M = 0.035  # from the flange, towards the fingers


def pixel_of(arm: SimulatedArm, point: np.ndarray) -> np.ndarray:
    """Return column and row of a point of the robot base frame in an image of 180 x 320, by the camera's extrinsics."""
    camera = arm.extrinsics()
    x, y, z = matrices_from_euler(camera[3:]).T @ (point - camera[:3])
    focal = 90.0 / np.tan(np.deg2rad(arm.domain.camera.vertical_fov_deg) / 2)
    return np.array([160.0 + focal * x / z, 90.0 + focal * y / z])


def hand_pixel(arm: SimulatedArm, state: np.ndarray) -> np.ndarray:
    """Return where the middle of the hand is in the image, in a measured state."""
    return pixel_of(arm, state[:3] + HAND_MIDDLE_M * matrices_from_euler(state[3:6])[:, 2])
