"""Demonstrations stay in their box and are measured with a lag; inverse kinematics returns to every pose."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from vjepa2_ac.simulation.domains import DOMAIN_A
from vjepa2_ac.simulation.motion import (
    HIGH,
    HOME,
    LOW,
    MotionRecipe,
    OutOfReachError,
    forward_kinematics,
    inverse_kinematics,
    random_reaching,
    tracking_share,
)
from vjepa2_ac.spaces import matrices_from_euler

RECIPE = MotionRecipe()


def test_random_reaching_stays_in_the_box_and_joint_limits() -> None:
    motion = random_reaching(DOMAIN_A, 81, np.random.default_rng(0))
    positions = motion.commanded_poses[:, :3]
    assert (positions > np.array(RECIPE.low_m) - 1e-4).all()
    assert (positions < np.array(RECIPE.high_m) + 1e-4).all()
    assert (motion.joints >= LOW).all()
    assert (motion.joints <= HIGH).all()
    downward = matrices_from_euler(motion.commanded_poses[:, 3:])[:, 2, 2]
    np.testing.assert_allclose(downward, -1.0, atol=1e-6)


def test_measured_poses_lag_behind_commanded_poses() -> None:
    motion = random_reaching(DOMAIN_A, 61, np.random.default_rng(1))
    commanded, measured = motion.commanded_poses[:, :3], motion.poses[:, :3]
    same_time = np.linalg.norm(measured - commanded, axis=1).mean()
    one_later = np.linalg.norm(measured[1:] - commanded[:-1], axis=1).mean()
    assert 0.005 < one_later < same_time < 0.05
    share = tracking_share(DOMAIN_A.lag_s)
    expected_changes = share * (motion.commanded_joints[:-1] - motion.joints[:-1])
    np.testing.assert_allclose(np.diff(motion.joints, axis=0), expected_changes, atol=1e-12)


def random_joints(rng: np.random.Generator, spread_rad: float) -> np.ndarray:
    return rng.uniform(np.maximum(LOW, HOME - spread_rad), np.minimum(HIGH, HOME + spread_rad))


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


def test_unreachable_pose_raises() -> None:
    with pytest.raises(OutOfReachError, match="no joint angles"):
        inverse_kinematics(np.array([1.5, 0.0, 0.5, np.pi, 0.0, 0.0]))


def test_shape_checks_reject_wrong_array_shapes() -> None:
    """`tests/conftest.py` checks the annotations of this package."""
    with pytest.raises(TypeCheckError):
        forward_kinematics(np.zeros(3))
