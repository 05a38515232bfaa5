"""Pose integration equals the official code, and gradients flow through it."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from paths import GOLDEN
from synthetic import synthetic_states
from vjepa2_ac.spaces import (
    actions_from_states,
    apply_actions,
    euler_from_matrices,
    integrate_changes,
    matrices_from_euler,
)


def assert_same_poses(actual: torch.Tensor, expected: np.ndarray, tolerance: float) -> None:
    """Compare positions and grippers as numbers, orientations as rotations."""
    columns = [0, 1, 2, 6]
    np.testing.assert_allclose(actual.numpy()[..., columns], expected[..., columns], atol=tolerance)
    turned = [Rotation.from_euler("xyz", poses[..., 3:6].reshape(-1, 3)) for poses in (actual.numpy(), expected)]
    assert (turned[0] * turned[1].inv()).magnitude().max() <= tolerance


@pytest.mark.parametrize("trajectory", [0, 1])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 1e-5)])
def test_composed_poses_equal_official_poses(trajectory: int, dtype: torch.dtype, tolerance: float) -> None:
    with np.load(GOLDEN / "poses.npz") as official:
        poses, deltas = (torch.from_numpy(official[f"{name}_{trajectory}"]).to(dtype) for name in ("poses", "deltas"))
        assert_same_poses(apply_actions(poses[:-1], deltas), official[f"composed_{trajectory}"], tolerance)


def test_actions_of_a_trajectory_reproduce_it() -> None:
    states = synthetic_states(30)
    actions = torch.from_numpy(actions_from_states(states))
    integrated = integrate_changes(torch.from_numpy(states[0]), torch.stack([actions, actions * 0]))
    assert_same_poses(integrated[0], states, 1e-6)
    assert_same_poses(integrated[1], np.repeat(states[:1], 30, axis=0), 1e-6)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, 1.5, 0.0])
def test_angles_near_gimbal_lock_represent_the_rotation(pitch: float) -> None:
    matrices = matrices_from_euler(torch.tensor([[0.4, pitch, -1.1]], dtype=torch.float64))
    torch.testing.assert_close(matrices_from_euler(euler_from_matrices(matrices)), matrices, atol=2e-6, rtol=0)


def test_gimbal_lock_has_zero_yaw_and_finite_gradients() -> None:
    up = torch.tensor([[0.0, 0.6, 0.8], [0.0, 0.8, -0.6], [-1.0, 0.0, 0.0]], requires_grad=True)
    angles = euler_from_matrices(up)
    assert not angles[2].detach()
    torch.testing.assert_close(matrices_from_euler(angles), up)
    angles.sum().backward()
    assert torch.isfinite(up.grad).all()


def test_gradients_equal_finite_differences() -> None:
    state = torch.tensor([0.4, 0.0, 0.3, 3.0, 0.3, 0.2, 0.5], dtype=torch.float64)
    actions = 0.1 * torch.randn(2, 3, 7, generator=torch.Generator().manual_seed(0)).double()
    assert torch.autograd.gradcheck(lambda changes: integrate_changes(state, changes), (actions.requires_grad_(),))


def test_autocast_keeps_pose_precision() -> None:
    states, actions = torch.rand(5, 7), 0.1 * torch.rand(5, 7)
    plain = apply_actions(states, actions)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(apply_actions(states, actions), plain)
