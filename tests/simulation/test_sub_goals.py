"""Sub-goals from a demonstration in the simulator: the grasp is among them."""

import numpy as np
import pytest

from decisions import controller as tiny_controller
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.simulation.benchmark import Planning, demonstrate, demonstrated_goals
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B, Domain
from vjepa2_ac.simulation.rollout import ArmEnvironment, Trial, run
from vjepa2_ac.simulation.tasks import GRASP_M, HOLDING, TaskName, arm_for, make_problem

LIMITS = LimitsConfig()


def trial_of(task: TaskName, domain: Domain, index: int, seed: int = 0, goals: tuple[SubGoal, ...] = ()) -> Trial:
    return Trial(index, 5, 4, make_problem(task, domain, seed, index), goals=goals)


@pytest.mark.parametrize("domain", [DOMAIN_A, DOMAIN_B], ids=["A", "B"])
def test_the_grasp_is_among_the_goals_of_a_pick(domain: Domain) -> None:
    arm = arm_for("pick", domain, size=(36, 64))
    for index in range(2):
        trial = trial_of("pick", domain, index, seed=4)
        goals, shown = demonstrated_goals(trial, arm, LIMITS), demonstrate(trial, arm, LIMITS)
        assert [goal.name for goal in goals] == ["before closing", "closed", "end"]
        assert [goal.gripper for goal in goals] == ["held", "close", "held"]
        frames = [int(np.argmax([np.array_equal(goal.image, frame) for frame in shown.frames])) for goal in goals]
        at_block, closed, lifted = shown.states[frames]
        over_block = trial.problem.block_start[:3] + np.array([0, 0, GRASP_M])
        np.testing.assert_allclose(at_block[:3], over_block, atol=0.015)
        assert closed[6] == pytest.approx(HOLDING, abs=0.05)
        assert np.linalg.norm(closed[:3] - at_block[:3]) < 0.01
        assert np.linalg.norm(lifted[:3] - trial.problem.goal[:3]) < 0.02
        steps = np.diff([0, *frames])
        assert [goal.at_least for goal in goals] == [max(1, step - 3) for step in steps]
        assert [goal.at_most for goal in goals] == [*(step + 3 for step in steps[:-1]), None]


def test_the_gripper_of_the_oracle_is_free_and_a_task_without_it_has_one_goal() -> None:
    for task, names in (("reach", ["end"]), ("push", ["end"]), ("pick", ["before closing", "closed", "end"])):
        arm, trial = arm_for(task, DOMAIN_A, size=(36, 64)), trial_of(task, DOMAIN_A, 1)
        goals = demonstrated_goals(trial, arm, LimitsConfig(gripper_mode="held"))
        assert [goal.name for goal in goals] == names
    with pytest.raises(InputError, match=r"problem 1 \(pick\): the oracle ends .* after 12 model steps"):
        demonstrate(trial, arm, LimitsConfig(xyz=(0.05, 0.05, 0)))


def test_every_step_of_a_demonstration_is_a_goal_up_to_where_it_rests() -> None:
    arm, trial = arm_for("pick", DOMAIN_A, size=(36, 64)), trial_of("pick", DOMAIN_A, 0, seed=4)
    key_goals, goals = (demonstrated_goals(trial, arm, LIMITS, way) for way in ("demonstration", "every-step"))
    for goal, frame in zip(goals, demonstrate(trial, arm, LIMITS).frames[1:], strict=False):
        np.testing.assert_array_equal(goal.image, frame)
    np.testing.assert_array_equal(goals[-1].image, key_goals[-1].image)
    assert [goal.name for goal in goals if goal.name != "on the way"] == [goal.name for goal in key_goals]
    assert [goal.at_most for goal in goals] == [*[2] * (len(goals) - 1), None]


def test_a_planner_is_given_the_goals_of_the_trial() -> None:
    controller = tiny_controller(horizon=1)
    arm = arm_for("pick", DOMAIN_A)
    goals = demonstrated_goals(trial_of("pick", DOMAIN_A, 0), arm, LIMITS, "every-step")
    episode = run(ArmEnvironment(arm), Planning(controller), trial_of("pick", DOMAIN_A, 0, goals=goals))
    closes = [goal.gripper for goal in goals].index("close")
    assert not episode.actions[:closes, 6].any()
    assert controller.decision is not None
    assert controller.decision.progress.place > 0
