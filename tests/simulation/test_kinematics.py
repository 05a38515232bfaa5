"""The arm agrees with Franka's published kinematics, and follows commands."""

import numpy as np
import pytest

from vjepa2_ac.simulation.motion import (
    HIGH,
    HOME,
    LOW,
    OutOfReachError,
    forward_kinematics,
    inverse_kinematics,
)
from vjepa2_ac.spaces import matrices_from_euler

# Franka's table once more, as (a, alpha, d): independent of the product under test.
FRANKA_TABLE = [
    (0.0, 0.0, 0.333),
    (0.0, -np.pi / 2, 0.0),
    (0.0, np.pi / 2, 0.316),
    (0.0825, np.pi / 2, 0.0),
    (-0.0825, -np.pi / 2, 0.384),
    (0.0, np.pi / 2, 0.0),
    (0.088, np.pi / 2, 0.0),
]


def denavit_hartenberg(a: float, alpha: float, d: float, theta: float) -> np.ndarray:
    """Return Craig's link transform, written out."""
    ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
    return np.array([[ct, -st, 0, a], [st * ca, ct * ca, -sa, -d * sa], [st * sa, ct * sa, ca, d * ca], [0, 0, 0, 1]])


def random_joints(rng: np.random.Generator, spread_rad: float) -> np.ndarray:
    return rng.uniform(np.maximum(LOW, HOME - spread_rad), np.minimum(HIGH, HOME + spread_rad))


def test_forward_kinematics_is_the_product_of_the_link_transforms() -> None:
    rng = np.random.default_rng(0)
    for joints in rng.uniform(LOW, HIGH, size=(20, 7)):
        frame = np.eye(4)
        for link, angle in zip(FRANKA_TABLE, joints, strict=True):
            frame = frame @ denavit_hartenberg(*link, angle)
        frame = frame @ denavit_hartenberg(0.0, 0.0, 0.107, 0.0)
        pose = forward_kinematics(joints)
        np.testing.assert_allclose(pose[:3], frame[:3, 3], atol=1e-12)
        np.testing.assert_allclose(matrices_from_euler(pose[3:]), frame[:3, :3], atol=1e-9)


def test_inverse_kinematics_returns_to_every_pose_within_the_limits() -> None:
    rng = np.random.default_rng(3)
    for _ in range(100):
        pose = forward_kinematics(random_joints(rng, 0.8))
        joints = inverse_kinematics(pose)
        assert ((joints >= LOW) & (joints <= HIGH)).all()
        reached = forward_kinematics(joints)
        assert np.linalg.norm(reached[:3] - pose[:3]) < 1e-4
        cosine = (np.trace(matrices_from_euler(reached[3:]) @ matrices_from_euler(pose[3:]).T) - 1) / 2
        assert np.rad2deg(np.arccos(min(1.0, cosine))) < 0.05


def test_a_pose_out_of_reach_is_refused() -> None:
    with pytest.raises(OutOfReachError, match="no joint angles"):
        inverse_kinematics(np.array([1.5, 0.0, 0.5, np.pi, 0.0, 0.0]))
