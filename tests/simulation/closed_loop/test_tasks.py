"""Problems are the same in every world, within reach, and neither trivial nor hopeless."""

import numpy as np
import pytest

from vjepa2_ac.geometry import matrices_from_euler
from vjepa2_ac.simulation.closed_loop.tasks import GRASP_M, HOLDING, LIFT_M, PUSH_WAY_M, SUCCESS_M, make_problem
from vjepa2_ac.simulation.world.domains import DOMAIN_A, DOMAIN_B, Domain
from vjepa2_ac.simulation.world.kinematics import forward_kinematics, inverse_kinematics
from vjepa2_ac.simulation.world.motion import MotionRecipe, rest_joints
from vjepa2_ac.simulation.world.scene import BLOCK_M

RECIPE = MotionRecipe()


def in_world(state: np.ndarray, domain: Domain) -> np.ndarray:
    return domain.base_pose()[:3, :3] @ state[:3]


@pytest.mark.parametrize("task", ["reach", "push", "pick"])
def test_a_problem_is_the_same_in_the_world_whatever_the_domain(task: str) -> None:
    turn_a, turn_b = (domain.base_pose()[:3, :3] for domain in (DOMAIN_A, DOMAIN_B))
    for index in range(6):
        one, other = (make_problem(task, domain, 3, index) for domain in (DOMAIN_A, DOMAIN_B))
        for end in ("block_start", "block_goal") if task != "reach" else ():
            ours, theirs = getattr(one, end), getattr(other, end)
            np.testing.assert_allclose(in_world(ours, DOMAIN_A), in_world(theirs, DOMAIN_B), atol=1e-12)
            assert ours[3] - theirs[3] == pytest.approx(np.deg2rad(DOMAIN_B.base_yaw_deg))
        for end in ("start", "goal"):
            ours, theirs = getattr(one, end), getattr(other, end)
            np.testing.assert_allclose(in_world(ours, DOMAIN_A), in_world(theirs, DOMAIN_B), atol=1e-12)
            np.testing.assert_allclose(
                turn_a @ matrices_from_euler(ours[3:6]), turn_b @ matrices_from_euler(theirs[3:6]), atol=1e-9
            )
            assert np.abs(ours[:3] - theirs[:3]).max() > 0.05  # in the frames of bases that are turned
            assert ours[6] == theirs[6]


def test_problems_are_a_pure_function_of_seed_and_index() -> None:
    first, again = (make_problem("reach", DOMAIN_A, 1, 2) for _ in range(2))
    np.testing.assert_array_equal(first.start, again.start)
    np.testing.assert_array_equal(first.goal, again.goal)
    for seed, index in ((1, 3), (2, 2)):
        assert np.abs(make_problem("reach", DOMAIN_A, seed, index).goal - first.goal).max() > 0.01


def test_reach_is_in_the_box_and_12_to_25_cm_away_without_rotation() -> None:
    problems = [make_problem("reach", DOMAIN_A, 0, index) for index in range(100)]
    ways = np.array([problem.distance_m(problem.start) for problem in problems])
    assert ((ways >= 0.12) & (ways <= 0.25)).all()
    assert np.ptp(ways) > 0.1
    for problem in problems:
        for state in (problem.start, problem.goal):
            assert (state[:3] >= RECIPE.low_m).all()
            assert (state[:3] <= RECIPE.high_m).all()
            np.testing.assert_allclose(matrices_from_euler(state[3:6])[:, 2], [0, 0, -1], atol=1e-9)
        np.testing.assert_array_equal(problem.start[3:], problem.goal[3:])
    assert {problem.start[6] for problem in problems} == {0.0, 1.0}
    assert np.ptp([problem.start[5] for problem in problems]) > 1.0


@pytest.mark.parametrize("task", ["reach", "push", "pick"])
def test_every_start_and_goal_can_be_reached_in_both_domains(task: str) -> None:
    for domain in (DOMAIN_A, DOMAIN_B):
        rest = rest_joints(domain)
        for index in range(8):
            problem = make_problem(task, domain, 0, index)
            for state in (problem.start, problem.goal):
                joints = inverse_kinematics(state[:6], rest, rest=rest)
                np.testing.assert_allclose(forward_kinematics(joints)[:3], state[:3], atol=1e-4)


def test_a_push_begins_behind_the_block_and_ends_behind_its_goal() -> None:
    ways = []
    for index in range(60):
        problem = make_problem("push", DOMAIN_A, 0, index)
        way = (problem.block_goal - problem.block_start)[:2]
        ways.append(way)
        assert PUSH_WAY_M[0] <= np.linalg.norm(way) <= PUSH_WAY_M[1]
        ahead = way / np.linalg.norm(way)
        before = (problem.block_start[:2] - problem.start[:2]) @ ahead
        after = (problem.block_goal[:2] - problem.goal[:2]) @ ahead
        assert BLOCK_M / 2 < after < before - 0.02
        assert np.linalg.norm(problem.block_goal[:2] - problem.goal[:2]) == pytest.approx(after)  # on the line
        assert problem.start[6] == problem.goal[6] == 1.0
        assert problem.block_start[2] == problem.block_goal[2] == BLOCK_M / 2
        assert problem.distance_m(problem.start, problem.block_start) == pytest.approx(np.linalg.norm(way))
    angles = np.rad2deg(np.arctan2(*np.array(ways).T[::-1]))
    assert all((np.abs(angles - ahead) < 25).any() for ahead in (-90, 0, 90))
    assert PUSH_WAY_M[0] > 2 * SUCCESS_M["push"]


def test_a_pick_begins_over_the_block_and_ends_with_it_in_the_hand() -> None:
    for index in range(30):
        problem = make_problem("pick", DOMAIN_A, 0, index)
        assert problem.start[6] == 0.0
        assert problem.goal[6] == pytest.approx(HOLDING)
        np.testing.assert_allclose(problem.goal[:3] - problem.block_goal[:3], [0.0, 0.0, GRASP_M], atol=1e-12)
        assert LIFT_M[0] <= problem.block_goal[2] - problem.block_start[2] <= LIFT_M[1]
        assert problem.start[2] - problem.block_start[2] > GRASP_M + 0.06
        hand = matrices_from_euler(problem.start[3:6])
        across = (
            hand @ np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
        )  # of the fingers: the flange's frame turned by 45 degrees
        block_turn = problem.block_start[3]
        sides = np.array([np.cos(block_turn), np.sin(block_turn)]), np.array([-np.sin(block_turn), np.cos(block_turn)])
        assert max(abs(across[:2] @ side) for side in sides) == pytest.approx(1.0, abs=1e-9)
    assert LIFT_M[0] > SUCCESS_M["pick"]


def test_the_distance_is_that_of_the_flange_in_metres() -> None:
    problem = make_problem("reach", DOMAIN_A, 0, 0)
    assert problem.distance_m(problem.goal) == 0.0
    turned = problem.goal + np.array([0.03, 0.0, -0.04, 0.2, 0.0, 0.1, 1.0])
    assert problem.distance_m(turned) == pytest.approx(0.05)
    pushed = make_problem("push", DOMAIN_A, 0, 0)
    with pytest.raises(ValueError, match="push is done by a block"):
        pushed.distance_m(pushed.start)


def test_an_unknown_task_is_refused() -> None:
    with pytest.raises((ValueError, TypeError), match="fly"):  # in tests, types are checked before
        make_problem("fly", DOMAIN_A, 0, 0)
