"""With contacts the arm follows the same commands, stops at obstacles, and moves the block."""

import numpy as np
import pytest

from vjepa2_ac.simulation.arm import ContactArm, SimulatedArm
from vjepa2_ac.simulation.domains import BLOCK_M, DOMAIN_A, DOMAIN_B, Domain
from vjepa2_ac.simulation.motion import downward_poses, poses_in_base
from vjepa2_ac.simulation.tasks import GRASP_M, HOLDING, arm_for
from vjepa2_ac.spaces import matrices_from_euler


@pytest.fixture
def arm() -> ContactArm:
    return ContactArm(DOMAIN_B)


def state_over(domain: Domain, x: float, y: float, z: float, closedness: float = 0.0) -> np.ndarray:
    """Return the state with the flange at a place of the world, pointing down."""
    pose = poses_in_base(downward_poses(np.array([[x, y, z, 0.0]])), domain)[0]
    return np.append(pose, closedness)


def block_at(domain: Domain, x: float, y: float, z: float = BLOCK_M / 2) -> np.ndarray:
    place = domain.base_pose()[:3, :3].T @ np.array([x, y, z])
    return np.append(place, -np.deg2rad(domain.base_yaw_deg))


def moved(state: np.ndarray, *way: float, closedness: float | None = None) -> np.ndarray:
    return np.array([*(state[:3] + way), *state[3:6], state[6] if closedness is None else closedness])


@pytest.mark.parametrize("domain", [DOMAIN_A, DOMAIN_B], ids=["A", "B"])
def test_where_nothing_is_in_the_way_the_arm_follows_as_without_contacts(domain: Domain) -> None:
    free, touching = SimulatedArm(domain), ContactArm(domain)
    for step in range(3):
        target = moved(free.state, 0.05, -0.05, -0.04, closedness=0.3 * (step + 1))
        one, other = free.command(target, 4), touching.command(target, 4)
        np.testing.assert_allclose(other[:3], one[:3], atol=2e-3)
        turn = matrices_from_euler(other[3:6]) @ matrices_from_euler(one[3:6]).T
        assert np.arccos(min(1.0, (np.trace(turn) - 1) / 2)) < 0.01
        assert other[6] == pytest.approx(one[6], abs=0.02)


def test_a_block_is_where_it_was_put_in_the_frame_of_the_base(arm: ContactArm) -> None:
    block = np.array([0.4, 0.2, 0.25, 0.3])
    arm.place(block, None)
    np.testing.assert_allclose(arm.block, block, atol=1e-9)
    in_world = DOMAIN_B.base_pose()[:3, :3] @ block[:3]
    np.testing.assert_allclose(arm._data.body("block").xpos, in_world, atol=1e-9)
    arm.command_joints(arm.joints, 0.0, 15)
    assert arm.block[2] == pytest.approx(BLOCK_M / 2, abs=2e-3)  # it fell on the table
    np.testing.assert_allclose(arm.block[:2], block[:2], atol=5e-3)


def test_a_grasped_block_is_lifted_held_and_let_go(arm: ContactArm) -> None:
    arm.set_state(state_over(DOMAIN_B, 0.48, 0.05, BLOCK_M / 2 + GRASP_M))
    arm.place(block_at(DOMAIN_B, 0.48, 0.05), None)
    closed = arm.command(moved(arm.state, 0.0, 0.0, 0.0, closedness=0.9), 8)
    assert closed[6] == pytest.approx(HOLDING, abs=0.06)  # measured where the block stops it
    for _ in range(3):
        arm.command(moved(arm.state, 0.0, 0.0, 0.05), 4)  # the gripper is told to stay: it goes on holding
    lifted = arm.block[2]
    assert lifted > BLOCK_M / 2 + 0.10
    arm.command(moved(arm.state, 0.0, 0.0, 0.0), 15)
    assert arm.block[2] == pytest.approx(lifted, abs=0.02)
    arm.command(moved(arm.state, 0.0, 0.0, 0.0, closedness=0.0), 15)
    assert arm.block[2] < 0.05


def test_only_tasks_with_a_block_have_one() -> None:
    for task in ("reach", "push", "pick"):
        assert (arm_for(task, DOMAIN_A, size=(18, 32)).block is None) == (task == "reach")
