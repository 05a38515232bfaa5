"""Problems are the same in every world, within reach, and neither trivial nor hopeless."""

import numpy as np
import pytest

from vjepa2_ac.simulation.domains import (
    BLOCK_M,
    DOMAIN_A,
    DOMAIN_B,
    FINGER_INSIDE_M,
    FINGER_TRAVEL_M,
    Domain,
)
from vjepa2_ac.simulation.tasks import (
    HOLDING,
    RELEASED,
    make_problem,
)
from vjepa2_ac.spaces import matrices_from_euler


def in_world(state: np.ndarray, domain: Domain) -> np.ndarray:
    return domain.base_pose()[:3, :3] @ state[:3]


TASKS = ["reach", "push", "pick", "place"]


@pytest.mark.parametrize("task", TASKS)
def test_problems_in_the_world_frame_do_not_depend_on_the_domain(task: str) -> None:
    turn_a, turn_b = (domain.base_pose()[:3, :3] for domain in (DOMAIN_A, DOMAIN_B))
    for index in range(6):
        problem_a, problem_b = (make_problem(task, domain, 3, index) for domain in (DOMAIN_A, DOMAIN_B))
        for end in ("block_start", "block_goal") if task != "reach" else ():
            pose_a, pose_b = getattr(problem_a, end), getattr(problem_b, end)
            np.testing.assert_allclose(in_world(pose_a, DOMAIN_A), in_world(pose_b, DOMAIN_B), atol=1e-12)
            assert pose_a[3] - pose_b[3] == pytest.approx(np.deg2rad(DOMAIN_B.base_yaw_deg))
        for end in ("start", "goal"):
            pose_a, pose_b = getattr(problem_a, end), getattr(problem_b, end)
            np.testing.assert_allclose(in_world(pose_a, DOMAIN_A), in_world(pose_b, DOMAIN_B), atol=1e-12)
            np.testing.assert_allclose(
                turn_a @ matrices_from_euler(pose_a[3:6]), turn_b @ matrices_from_euler(pose_b[3:6]), atol=1e-9
            )
            assert np.abs(pose_a[:3] - pose_b[:3]).max() > 0.05  # in the frames of bases that are turned
            assert pose_a[6] == pose_b[6]


@pytest.mark.parametrize(
    ("task", "goal", "block_goal"),
    [
        ("reach", [0.4396847047196296, 0.01860544981563761, 0.45383170152955726], None),
        ("push", [0.5114199059195207, -0.012427192193500351, 0.17], [0.5213982885988618, 0.04470801480800288, 0.03]),
        (
            "pick",
            [0.5089670030929729, -0.12002530164497903, 0.2823322387197327],
            [0.5089670030929729, -0.12002530164497903, 0.15233223871973267],
        ),
    ],
)
def test_problems_equal_those_of_earlier_versions(task: str, goal: list, block_goal: list | None) -> None:
    problem = make_problem(task, DOMAIN_A, 3, 1)
    np.testing.assert_allclose(problem.goal[:3], goal, rtol=0, atol=1e-14)
    assert (problem.block_goal is None) == (block_goal is None)
    if block_goal is not None:
        np.testing.assert_allclose(problem.block_goal[:3], block_goal, rtol=0, atol=1e-14)


def test_place_succeeds_if_block_is_released_on_the_mark() -> None:
    problem = make_problem("place", DOMAIN_A, 0, 0)
    beside, held_goal, open_hand = np.array([0.03, 0.0, 0.0, 1.0]), problem.goal.copy(), problem.goal
    held_goal[6] = HOLDING
    assert problem.succeeded(open_hand, problem.block_goal)
    assert problem.succeeded(open_hand, problem.block_goal + beside)
    assert not problem.succeeded(open_hand, problem.block_goal + 1.4 * beside)
    assert not problem.succeeded(held_goal, problem.block_goal)
    for height, lies in ((0.005, True), (0.015, False)):
        assert problem.succeeded(open_hand, problem.block_goal + height * np.eye(4)[2]) == lies
    assert not problem.succeeded(open_hand, problem.block_start)
    gap_m = FINGER_INSIDE_M + (1.0 - RELEASED) * FINGER_TRAVEL_M - BLOCK_M / 2
    assert gap_m == pytest.approx(0.004)
    with pytest.raises(ValueError, match="the task place needs the pose of a block"):
        problem.succeeded(open_hand)


def test_other_tasks_succeed_by_distance_alone() -> None:
    picked, reached = (make_problem(task, DOMAIN_A, 0, 0) for task in ("pick", "reach"))
    for height, is_success in ((0.049, True), (0.051, False)):
        assert picked.succeeded(picked.start, picked.block_goal - height * np.eye(4)[2]) == is_success
    assert reached.succeeded(reached.goal)
    assert not reached.succeeded(reached.start)
    turned = reached.goal + np.array([0.03, 0.0, -0.04, 0.2, 0.0, 0.1, 1.0])
    assert reached.distance_m(turned) == pytest.approx(0.05), "neither turns nor the gripper count"
