"""Goals of a demonstration in the simulator: the grasp is among them, and the evaluated arm is left alone."""

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from decisions import QUICK
from tiny_models import tiny_model
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.simulation.benchmark import DemonstratedGoals, DemonstrationSpec, demonstrate, every_step
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B
from vjepa2_ac.simulation.policies import Planning
from vjepa2_ac.simulation.rollout import put, run_episode
from vjepa2_ac.simulation.tasks import GRASP_M, HOLDING, arm_for, make_problem

SMALL = (36, 64)


@pytest.mark.parametrize("domain", [DOMAIN_A, DOMAIN_B], ids=["A", "B"])
def test_the_grasp_is_among_the_goals_of_a_pick(domain) -> None:
    arm = arm_for("pick", domain, size=SMALL)
    for index in range(3):
        problem = make_problem("pick", domain, 4, index)
        goals = DemonstratedGoals("pick", domain, size=SMALL)(problem)
        assert [goal.name for goal in goals] == ["before closing", "closed", "end"]
        assert [goal.gripper for goal in goals] == ["held", "close", "held"]
        seen, states = demonstrate(problem, arm, DemonstrationSpec())
        frames = [int(np.argmax([np.array_equal(goal.image, frame) for frame in seen])) for goal in goals]
        at_block, closed, lifted = states[frames]
        np.testing.assert_allclose(at_block[:3], problem.block_start[:3] + np.array([0, 0, GRASP_M]), atol=0.015)
        assert at_block[6] < 0.02
        assert closed[6] == pytest.approx(HOLDING, abs=0.05)
        assert np.linalg.norm(closed[:3] - at_block[:3]) < 0.01
        assert np.linalg.norm(lifted[:3] - problem.goal[:3]) < 0.02
        steps = np.diff([0, *frames])
        assert [goal.at_least for goal in goals] == [max(1, step - 3) for step in steps]
        assert [goal.at_most for goal in goals] == [*(step + 3 for step in steps[:-1]), None]


def test_a_task_without_the_gripper_has_its_end_as_the_only_goal() -> None:
    for task in ("reach", "push"):
        (goal,) = DemonstratedGoals(task, DOMAIN_A, size=SMALL)(make_problem(task, DOMAIN_A, 0, 1))
        assert (goal.name, goal.gripper, goal.at_most) == ("end", "held", None)


def test_the_gripper_of_who_demonstrates_is_free_whatever_the_planner_may_do() -> None:
    arm, problem = arm_for("pick", DOMAIN_A, size=SMALL), make_problem("pick", DOMAIN_A, 0, 0)
    held = DemonstrationSpec(LimitsConfig(gripper_mode="held"), slack=0)
    assert [goal.at_most for goal in DemonstratedGoals("pick", DOMAIN_A, held, SMALL)(problem)] == [3, 1, None]
    with pytest.raises(InputError, match=r"problem 0 \(pick\): the oracle ends .* after 3 model steps"):
        demonstrate(problem, arm, DemonstrationSpec(steps=3))


def test_every_step_of_a_demonstration_is_a_goal_up_to_where_it_rests() -> None:
    arm, problem = arm_for("pick", DOMAIN_A, size=SMALL), make_problem("pick", DOMAIN_A, 4, 0)
    key_goals, goals = (
        DemonstratedGoals("pick", DOMAIN_A, one, SMALL)(problem) for one in (None, every_step(DemonstrationSpec()))
    )
    frames, states = demonstrate(problem, arm, DemonstrationSpec())
    for goal, frame in zip(goals, frames[1:], strict=False):
        np.testing.assert_array_equal(goal.image, frame)
    np.testing.assert_array_equal(goals[-1].image, key_goals[-1].image)
    assert [goal.name for goal in goals if goal.name != "on the way"] == [goal.name for goal in key_goals]
    assert [goal.gripper for goal in goals].count("close") == 1
    assert [goal.at_most for goal in goals] == [*[2] * (len(goals) - 1), None]
    hand = np.linalg.norm(np.diff(states[: len(goals) + 1, :3], axis=0), axis=1)
    assert hand.max() < 0.08, "each goal is within a step of the one before"


def test_an_arm_that_is_steered_is_not_moved_by_the_demonstration() -> None:
    arm, problem = arm_for("pick", DOMAIN_A, size=SMALL), make_problem("pick", DOMAIN_A, 0, 0)
    before = put(arm, problem.start, problem.block_start).state
    DemonstratedGoals("pick", DOMAIN_A, size=SMALL)(problem)
    np.testing.assert_array_equal(arm.state, before)


def test_a_planner_is_given_the_goals_of_the_problem() -> None:
    controller = Controller(tiny_model(), QUICK.model_copy(update={"horizon": 1}))
    goals_of = DemonstratedGoals("pick", DOMAIN_A, DemonstrationSpec(slack=0))
    policy = Planning(controller, goals_of=goals_of)
    arm, problem = arm_for("pick", DOMAIN_A), make_problem("pick", DOMAIN_A, 0, 0)
    episode = run_episode(arm, policy, problem, steps=5)
    assert [bool(action) for action in episode.actions[:, 6]] == [False, False, False, True, False]
    assert controller.decision is not None
    assert (controller.decision.progress.place, controller.decision.progress.since) == (2, 4)
