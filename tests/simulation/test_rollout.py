"""Episodes end where the actions lead, oracles solve the tasks and show their sub-goals, and the metrics agree."""

from dataclasses import replace

import numpy as np
import pytest

from decisions import make_controller
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, Planning, demonstrate, demonstrated_goals, run_task
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B, Domain
from vjepa2_ac.simulation.motion import HIGH, forward_kinematics
from vjepa2_ac.simulation.policies import Oracle, RandomActions, ZeroActions, largest_action, shorten_to_limits
from vjepa2_ac.simulation.rollout import (
    ArmEnvironment,
    ClosedLoopResult,
    EpisodeResult,
    Observation,
    Trial,
    run_trial,
)
from vjepa2_ac.simulation.tasks import GRASP_M, HOLDING, RELEASED, STEPS, TaskName, arm_for, make_problem
from vjepa2_ac.spaces import actions_from_states

LIMITS = LimitsConfig(xyz=(0.075, 0.075, 0.075))
SMALL = LimitsConfig(xyz=(0.03, 0.03, 0.03))
UNSEEN = np.zeros((2, 2, 3), dtype=np.uint8)


class Scripted:
    """Follows a script, and stores its observations."""

    name, why = "scripted", "scripted"

    def __init__(self, *actions: np.ndarray) -> None:
        self.actions, self.observations = list(actions), []

    def reset(self, trial: Trial, goal_image: np.ndarray) -> None:  # noqa: ARG002 - of the protocol
        self.left, self.goal_image = list(self.actions), goal_image

    def act(self, observation: Observation) -> np.ndarray:
        self.observations.append(observation)
        return self.left.pop(0)


@pytest.fixture(scope="module")
def arm() -> SimulatedArm:
    return SimulatedArm(DOMAIN_B, size=(45, 80))


def make_action(*numbers: float) -> np.ndarray:
    return np.array([*numbers, *[0.0] * (7 - len(numbers))])


def trial_of(index: int, steps: int, stride: int = 4, seed: int = 0) -> Trial:
    return Trial(index, steps, stride, make_problem("reach", DOMAIN_B, seed, index))


CASES = [("reach", DOMAIN_B), ("push", DOMAIN_A), ("pick", DOMAIN_B), ("place", DOMAIN_A), ("place", DOMAIN_B)]


@pytest.mark.parametrize(("task", "domain"), CASES, ids=[f"{task} {domain.name}" for task, domain in CASES])
def test_oracle_solves_tasks_and_zero_and_random_actions_do_not(task: TaskName, domain: Domain) -> None:
    arm = arm_for(task, domain, size=(18, 32))
    oracle = run_task(BenchmarkOptions(task, domain, 3, seed=11), Oracle(LIMITS), arm)
    assert oracle.success_rate.value == 1.0
    assert oracle.estimates["final_distance_cm"].value < 3.0
    assert oracle.reason_counts == {"scripted": 3 * STEPS[task]}
    assert not oracle.unreachable.any()
    for episode in oracle.episodes:
        assert (np.abs(episode.actions) <= largest_action(LIMITS)).all()
        if task != "reach":
            assert episode.blocks.shape == (STEPS[task] + 1, 4)
            np.testing.assert_allclose(episode.blocks[0], episode.trial.problem.block_start, atol=1e-9)
            distance = np.linalg.norm(episode.blocks[-1, :3] - episode.trial.problem.block_goal[:3])
            assert episode.distances_m[-1] == pytest.approx(distance)
        if task == "place":
            carried = episode.blocks[:, 2] > 0.05
            assert episode.blocks[:, 2].max() > 0.06 + 0.03, "off the table by half a block"
            assert (episode.states[carried, 6] > RELEASED).all()
            assert not episode.reached[carried].any()
    for policy in (ZeroActions(), RandomActions(SMALL)):
        result = run_task(BenchmarkOptions(task, domain, 2, seed=5), policy, arm)
        assert result.success_rate.value == 0.0
        assert result.estimates["final_distance_cm"].value > 7.0


@pytest.mark.parametrize("task", ["reach", "push"])
def test_moving_objects_have_equal_start_positions_in_every_episode(task: TaskName) -> None:
    options = BenchmarkOptions(task, replace(DOMAIN_B, moving=3), episodes=2, steps=2, films=2)
    arm = arm_for(task, options.world, size=(45, 80))
    zero, random, zero_again = (
        run_task(options, policy, arm) for policy in (ZeroActions(), RandomActions(SMALL), ZeroActions())
    )
    for first, other, repeated in zip(zero.episodes, random.episodes, zero_again.episodes, strict=True):
        np.testing.assert_array_equal(first.goal_image, other.goal_image)
        np.testing.assert_array_equal(first.frames[0], other.frames[0])
        np.testing.assert_array_equal(first.frames, repeated.frames)
        assert (first.frames[1] != first.frames[2]).any(), "nothing moves"


def test_episode_starts_at_the_start_pose_and_has_the_goal_image(arm: SimulatedArm) -> None:
    trial, policy = trial_of(1, steps=2), Scripted(make_action(0.05), make_action(0.0, 0.05))
    result = run_trial(ArmEnvironment(arm), policy, trial, keep_frames=True)
    moved = actions_from_states(np.stack([trial.problem.start, result.states[0]]))  # -pi and pi are one angle
    np.testing.assert_allclose(moved, 0.0, atol=1e-3)
    arm.set_state(trial.problem.goal)
    assert np.abs(policy.goal_image.astype(int) - arm.image()).mean() < 2.0  # but for the spare joint
    np.testing.assert_array_equal(policy.goal_image, result.goal_image)
    assert (policy.goal_image != result.frames[0]).any()
    for step, observation in enumerate(policy.observations):
        np.testing.assert_array_equal(observation.image, result.frames[step])
        np.testing.assert_array_equal(observation.state, result.states[step])


def test_joint_actions_move_joints_within_their_limits(arm: SimulatedArm) -> None:
    policy = Scripted(0.1 * np.eye(8)[0], 9.0 * np.eye(8)[1])
    result = run_trial(ArmEnvironment(arm), policy, trial_of(1, steps=2, stride=60))
    before, after = (observation.joints for observation in policy.observations)
    np.testing.assert_allclose(after - before, 0.1 * np.eye(8)[0], atol=1e-3)
    np.testing.assert_allclose(result.states[1][:6], forward_kinematics(after[:7]), atol=1e-6)
    assert result.unreachable == 1, "no joint turns by 9 radians"
    assert arm.joints[1] == pytest.approx(HIGH[1], abs=1e-3)


def test_invalid_action_raises(arm: SimulatedArm) -> None:
    for action in (np.zeros(6), np.full(7, np.nan)):
        with pytest.raises(ValueError, match="not an action of 7 or 8 finite numbers"):
            run_trial(ArmEnvironment(arm), Scripted(action), trial_of(1, steps=1))
    with pytest.raises(ValueError, match="no problem of the simulated arm"):
        Oracle(LIMITS).reset(Trial(0, 1, 1), UNSEEN)


def test_unreachable_command_moves_the_arm_partially_and_is_counted(arm: SimulatedArm) -> None:
    script = Scripted(make_action(0.0, 0.0, 1.6), make_action(0.0, 0.0, 0.05))
    result = run_trial(ArmEnvironment(arm), script, trial_of(1, steps=2, stride=30))
    height_change = result.states[:, 2] - result.states[0, 2]
    assert 0.15 < height_change[1] < 1.0
    np.testing.assert_allclose(result.states[1, :2], result.states[0, :2], atol=2e-3)
    assert 1 <= result.unreachable <= 2
    assert run_trial(ArmEnvironment(arm), Scripted(make_action(0.0, 0.0, 0.05)), trial_of(1, 1)).unreachable == 0


def test_planner_acts_within_limits_and_stores_frames_of_some_episodes(arm: SimulatedArm) -> None:
    policy, reported = Planning(make_controller(horizon=1, limits=SMALL), name="tiny"), []
    options = BenchmarkOptions("reach", DOMAIN_B, episodes=2, steps=2, films=1)
    result = run_task(options, policy, arm, lambda *numbers: reported.append(numbers))
    assert (result.policy, result.reason_counts) == ("tiny", {"planned": 4})
    assert reported == [(decisions, 4) for decisions in range(5)]
    assert all((np.abs(episode.actions[:, :3]) <= 0.03).all() for episode in result.episodes)
    assert np.abs(result.episodes[0].actions[:, :3]).max() > 0
    assert [episode.frames is not None for episode in result.episodes] == [True, False]
    assert result.episodes[0].frames.shape == (3, 45, 80, 3)
    assert (result.seconds > 0).all()


def fake(*distances_m: float, unreachable: int = 0) -> EpisodeResult:
    count = len(distances_m)
    return EpisodeResult(
        trial=trial_of(0, count - 1),
        states=np.zeros((count, 7)),
        actions=np.zeros((count - 1, 7)),
        blocks=None,
        distances_m=np.array(distances_m),
        reached=np.array(distances_m) < 0.05,
        seconds=np.arange(1.0, count),
        reasons=("planned",) * (count - 2) + ("out of time",),
        unreachable=unreachable,
        goal_image=UNSEEN,
        frames=None,
    )


def test_success_is_measured_at_the_end_and_success_ever_separately() -> None:
    episodes = (fake(0.04, 0.03, 0.2), fake(0.2, 0.1, 0.049), fake(0.01, 0.2, 0.051, unreachable=2))
    result = ClosedLoopResult(BenchmarkOptions().trials(), "x", episodes)
    metrics = result.estimates
    assert result.successes.tolist() == [False, True, False]
    assert [episode.success_ever for episode in episodes] == [True, True, False]
    expected = {"success": 1 / 3, "success_ever": 2 / 3, "final_distance_cm": 10.0, "seconds_per_decision": 1.5}
    assert {name: metrics[name].value for name in expected} == pytest.approx(expected)
    assert 0 < metrics["success"].low < 1 / 3 < metrics["success"].high < 1
    assert metrics["final_distance_cm"].low < 10.0 < metrics["final_distance_cm"].high
    assert result.reason_counts == {"planned": 3, "out of time": 3}
    assert result.unreachable.tolist() == [0, 0, 2]
    reached_late = (fake(0.2, 0.04, 0.1, 0.03, 0.02), fake(0.2, 0.1, 0.04, 0.04, 0.04), fake(0.2, 0.01, 0.2, 0.2, 0.2))
    assert [episode.steps_needed for episode in reached_late] == [3, 2, None], "until it is done for good"
    assert fake(0.01, 0.02).steps_needed == 0
    assert replace(result, episodes=reached_late).estimates["steps_needed"].value == 2.5


def test_long_actions_are_scaled_to_the_limits_without_fixed_axes() -> None:
    limits = LimitsConfig(xyz=(0.05, 0.1, 0.0), rotation=0.2, gripper=0.5)
    cut = shorten_to_limits(np.array([0.1, 0.1, 0.3, 0.1, 0.4, 0.0, -0.8]), limits)
    np.testing.assert_allclose(cut, [0.05, 0.05, 0.0, 0.05, 0.2, 0.0, -0.5], atol=1e-9)
    assert (np.abs(cut) <= largest_action(limits)).all()
    small = np.array([0.01, 0.02, 0.0, 0.1, 0.0, 0.0, 0.1])
    np.testing.assert_array_equal(shorten_to_limits(small, limits), small)
    assert shorten_to_limits(np.ones(7), LimitsConfig(gripper_mode="held"))[6] == 0.0


def test_random_actions_depend_on_the_trial_and_cover_the_limits() -> None:
    policy, draws = RandomActions(LIMITS, seed=4), []
    for index in (0, 1, 0):
        trial = trial_of(index, 1)
        policy.reset(trial, UNSEEN)
        draws.append(np.stack([policy.act(Observation(UNSEEN, trial.problem.start)) for _ in range(50)]))
    np.testing.assert_array_equal(draws[0], draws[2])
    assert (draws[0] != draws[1]).any()
    assert (np.abs(draws[0]) <= largest_action(LIMITS)).all()
    assert np.abs(draws[0])[:, [0, 1, 2, 6]].max(axis=0) == pytest.approx(largest_action(LIMITS)[[0, 1, 2, 6]], rel=0.2)
    assert not draws[0][:, 3:6].any()


USUAL = LimitsConfig()


def trial_with_goals(
    task: TaskName, domain: Domain, index: int, seed: int = 0, goals: tuple[SubGoal, ...] = ()
) -> Trial:
    return Trial(index, 5, 4, make_problem(task, domain, seed, index), goals=goals)


@pytest.mark.parametrize("domain", [DOMAIN_A, DOMAIN_B], ids=["A", "B"])
def test_sub_goals_of_pick_contain_the_grasp(domain: Domain) -> None:
    arm = arm_for("pick", domain, size=(36, 64))
    for index in range(2):
        trial = trial_with_goals("pick", domain, index, seed=4)
        goals, shown = demonstrated_goals(trial, arm, USUAL), demonstrate(trial, arm, USUAL)
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


def test_oracle_ignores_gripper_limits_and_reach_has_a_single_goal() -> None:
    for task, names in (("reach", ["end"]), ("push", ["end"]), ("pick", ["before closing", "closed", "end"])):
        arm, trial = arm_for(task, DOMAIN_A, size=(36, 64)), trial_with_goals(task, DOMAIN_A, 1)
        goals = demonstrated_goals(trial, arm, LimitsConfig(gripper_mode="held"))
        assert [goal.name for goal in goals] == names
    with pytest.raises(InputError, match=r"problem 1 \(pick\): the oracle stops .* after 12 model steps"):
        demonstrate(trial, arm, LimitsConfig(xyz=(0.05, 0.05, 0)))


def test_every_step_sub_goals_stop_where_the_demonstration_stops() -> None:
    arm, trial = arm_for("pick", DOMAIN_A, size=(36, 64)), trial_with_goals("pick", DOMAIN_A, 0, seed=4)
    key_goals, goals = (demonstrated_goals(trial, arm, USUAL, source) for source in ("demonstration", "every-step"))
    for goal, frame in zip(goals, demonstrate(trial, arm, USUAL).frames[1:], strict=False):
        np.testing.assert_array_equal(goal.image, frame)
    np.testing.assert_array_equal(goals[-1].image, key_goals[-1].image)
    assert [goal.name for goal in goals if goal.name != "on the way"] == [goal.name for goal in key_goals]
    assert [goal.at_most for goal in goals] == [*[2] * (len(goals) - 1), None]


def test_planner_follows_the_goals_of_the_trial() -> None:
    planner = make_controller(horizon=1)
    arm = arm_for("pick", DOMAIN_A)
    goals = demonstrated_goals(trial_with_goals("pick", DOMAIN_A, 0), arm, USUAL, "every-step")
    episode = run_trial(ArmEnvironment(arm), Planning(planner), trial_with_goals("pick", DOMAIN_A, 0, goals=goals))
    closes = [goal.gripper for goal in goals].index("close")
    assert not episode.actions[:closes, 6].any()
    assert planner.decision is not None
    assert planner.decision.progress.goal_index > 0
