"""Poses and actions equal the official code and satisfy the invariants of trajectories (golden/DATA_ORIGIN.md)."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from paths import GOLDEN
from synthetic import synthetic_states
from vjepa2_ac.spaces import (
    actions_from_states,
    apply_action,
    euler_from_matrices,
    matrices_from_euler,
    states_in_camera_frame,
)


@pytest.fixture(params=[0, 1], scope="module")
def official(request: pytest.FixtureRequest) -> dict[str, np.ndarray]:
    with np.load(GOLDEN / "poses.npz") as arrays:
        return {
            name.removesuffix(f"_{request.param}"): arrays[name]
            for name in arrays.files
            if name[-1] == str(request.param)
        }


def assert_same_pose(actual: np.ndarray, expected: np.ndarray, tolerance: float = 1e-9) -> None:
    """Compare positions and grippers as numbers, orientations as rotations."""
    np.testing.assert_allclose(actual[..., :3], expected[..., :3], atol=tolerance)
    np.testing.assert_allclose(actual[..., 6:], expected[..., 6:], atol=tolerance)
    np.testing.assert_allclose(
        matrices_from_euler(actual[..., 3:6]), matrices_from_euler(expected[..., 3:6]), atol=tolerance
    )


def test_actions_equal_official_actions(official: dict[str, np.ndarray]) -> None:
    np.testing.assert_allclose(actions_from_states(official["poses"]), official["deltas"], atol=1e-9)


def test_camera_frame_equals_official_camera_frame(official: dict[str, np.ndarray]) -> None:
    states = states_in_camera_frame(official["poses"], official["extrinsics"])
    np.testing.assert_allclose(states, official["camera_frame"], atol=1e-9)


def test_applied_actions_equal_official_poses(official: dict[str, np.ndarray]) -> None:
    poses = apply_action(official["poses"][:-1], official["deltas"])
    assert_same_pose(poses, official["composed"], 1e-6)


@settings(max_examples=30)
@given(seed=st.integers(0, 2**31), stride=st.integers(1, 15))
def test_integrating_the_actions_of_a_trajectory_returns_its_states(seed: int, stride: int) -> None:
    states = synthetic_states(60, seed=seed)[::stride]
    pose = states[0]
    for action, expected in zip(actions_from_states(states), states[1:], strict=True):
        pose = apply_action(pose, action)
        assert_same_pose(pose, expected)


@pytest.mark.parametrize("library", [np.asarray, torch.from_numpy], ids=["numpy", "torch"])
def test_euler_angles_equal_scipy(library: Any) -> None:
    angles = np.random.default_rng(0).uniform(-3, 3, (500, 3))
    expected = Rotation.from_euler("xyz", angles)
    matrices = matrices_from_euler(library(angles))
    np.testing.assert_allclose(np.asarray(matrices), expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(np.asarray(euler_from_matrices(matrices)), expected.as_euler("xyz"), atol=1e-9)


def test_single_state_raises() -> None:
    with pytest.raises(ValueError, match="two states"):
        actions_from_states(np.zeros((1, 7)))
