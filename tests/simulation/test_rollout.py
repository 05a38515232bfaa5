"""Episodes end where the actions lead, and the metrics agree."""

from dataclasses import replace

import numpy as np
import pytest

from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B
from vjepa2_ac.simulation.tasks import TaskName, TaskProblem, arm_for, make_problem
from vjepa2_ac.spaces import actions_from_states

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from tiny_models import tiny_model
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.motion import HIGH, forward_kinematics
from vjepa2_ac.simulation.policies import (
    Moves,
    Oracle,
    Planning,
    RandomActions,
    ZeroActions,
    farthest,
    shortened,
)
from vjepa2_ac.simulation.rollout import (
    ClosedLoopResult,
    EpisodeResult,
    RolloutSpec,
    run_episode,
    run_task,
)

LIMITS = LimitsConfig(xyz=(0.075, 0.075, 0.075))
SMALL = LimitsConfig(xyz=(0.03, 0.03, 0.03))


class Scripted:
    """Follows a script, and records its observations."""

    name, why, moves = "scripted", "told", Moves.FLANGE

    def __init__(self, *actions: np.ndarray) -> None:
        self.actions, self.seen = list(actions), []

    def reset(self, problem: TaskProblem, goal_image: np.ndarray) -> None:  # noqa: ARG002 - of the protocol
        self.left, self.goal_image = list(self.actions), goal_image

    def act(self, image: np.ndarray, state: np.ndarray) -> np.ndarray:
        self.seen.append((image, state))
        return self.left.pop(0)


@pytest.fixture(scope="module")
def arm() -> SimulatedArm:
    return SimulatedArm(DOMAIN_B, size=(45, 80))


def way(*numbers: float) -> np.ndarray:
    return np.array([*numbers, *[0.0] * (7 - len(numbers))])


def test_the_oracle_succeeds_and_nothing_and_chance_do_not(arm: SimulatedArm) -> None:
    results = [
        run_task(RolloutSpec("reach", DOMAIN_B, 5), policy, arm)
        for policy in (Oracle(LIMITS), ZeroActions(), RandomActions(SMALL))
    ]
    oracle, nothing, chance = results
    assert oracle.success_rate.value == 1.0
    assert oracle.final_distance_cm.value < 0.5
    assert nothing.success_rate.value == nothing.success_ever_rate.value == 0.0
    np.testing.assert_allclose(nothing.distance_cm[:, -1], nothing.distance_cm[:, 0], atol=1e-2)
    assert chance.success_rate.value < 0.3
    assert [result.policy for result in results] == ["oracle", "zero action", "random"]
    assert oracle.why_counts == {"scripted": 40}
    assert not oracle.unreachable.any()


@pytest.mark.parametrize("task", ["reach", "push"])
def test_moving_objects_start_every_episode_where_they_start_for_every_policy(task: TaskName) -> None:
    spec = RolloutSpec(task, replace(DOMAIN_B, moving=3), episodes=2, steps=2, films=2)
    arm = arm_for(task, spec.world, size=(45, 80))
    zero, random, again = (run_task(spec, one, arm) for one in (ZeroActions(), RandomActions(SMALL), ZeroActions()))
    for first, other, repeated in zip(zero.episodes, random.episodes, again.episodes, strict=True):
        np.testing.assert_array_equal(first.goal_image, other.goal_image)
        np.testing.assert_array_equal(first.frames[0], other.frames[0])
        np.testing.assert_array_equal(first.frames, repeated.frames)
        assert (first.frames[1] != first.frames[2]).any(), "nothing moves"


def test_an_episode_starts_at_the_start_and_shows_the_goal(arm: SimulatedArm) -> None:
    problem, policy = make_problem("reach", DOMAIN_B, 0, 1), Scripted(way(0.05), way(0.0, 0.05))
    result = run_episode(arm, policy, problem, steps=2, keep_frames=True)
    np.testing.assert_allclose(result.states[0], problem.start, atol=1e-3)
    arm.set_state(problem.goal)
    difference = np.abs(policy.goal_image.astype(int) - arm.image())
    assert difference.mean() < 2.0  # but for the spare joint
    np.testing.assert_array_equal(policy.goal_image, result.goal_image)
    assert (policy.goal_image != result.frames[0]).any()
    for step, (image, state) in enumerate(policy.seen):
        np.testing.assert_array_equal(image, result.frames[step])
        np.testing.assert_array_equal(state, result.states[step])


def test_an_action_of_a_model_step_is_followed_with_the_arms_lag(arm: SimulatedArm) -> None:
    problem = make_problem("reach", DOMAIN_B, 0, 1)
    short, long = (
        run_episode(arm, Scripted(way(0.05, 0.0, -0.02, 0, 0, 0.1, 0.5)), problem, steps=1, stride=stride)
        for stride in (4, 30)
    )
    wanted = np.array([0.05, 0.0, -0.02, 0.0, 0.0, 0.1])
    sign = 1.0 if problem.start[6] == 0 else 0.0  # a closed gripper cannot close further
    (moved,), (settled,) = (actions_from_states(result.states) for result in (short, long))
    np.testing.assert_allclose(settled[:6], wanted, atol=1e-3)
    np.testing.assert_allclose(settled[6], 0.5 * sign, atol=1e-3)
    share = np.linalg.norm(moved[:3]) / np.linalg.norm(wanted[:3])
    assert share == pytest.approx(1 - np.exp(-4 / 15 / DOMAIN_B.lag_s), abs=0.01)


def test_joints_are_observed_moved_and_kept_within_their_limits(arm: SimulatedArm) -> None:
    problem, policy = make_problem("reach", DOMAIN_B, 0, 1), Scripted(0.1 * np.eye(8)[0], 9.0 * np.eye(8)[1])
    policy.moves = Moves.JOINTS
    result = run_episode(arm, policy, problem, steps=2, stride=60)
    (_, before), (_, after) = policy.seen
    np.testing.assert_allclose(after - before, 0.1 * np.eye(8)[0], atol=1e-3)
    np.testing.assert_allclose(result.states[1][:6], forward_kinematics(after[:7]), atol=1e-6)
    assert result.unreachable == 1, "no joint turns by 9 radians"
    assert arm.joints[1] == pytest.approx(HIGH[1], abs=1e-3)
    policy.actions = [np.zeros(7)]
    for actor, of in ((policy, 8), (Scripted(np.full(7, np.nan)), 7)):
        with pytest.raises(ValueError, match=f"no action of {of} finite numbers"):
            run_episode(arm, actor, problem, steps=1)


def test_the_same_problem_has_the_same_result_whatever_was_before(arm: SimulatedArm) -> None:
    problem = make_problem("reach", DOMAIN_B, 0, 2)
    first = run_episode(arm, RandomActions(SMALL), problem, steps=3)
    run_episode(arm, RandomActions(SMALL, seed=1), make_problem("reach", DOMAIN_B, 5, 0), steps=3)
    again = run_episode(arm, RandomActions(SMALL), problem, steps=3)
    np.testing.assert_array_equal(first.states, again.states)
    np.testing.assert_array_equal(first.goal_image, again.goal_image)


def test_a_command_out_of_reach_takes_the_arm_part_of_the_way_and_is_counted(arm: SimulatedArm) -> None:
    problem = make_problem("reach", DOMAIN_B, 0, 1)
    result = run_episode(arm, Scripted(way(0.0, 0.0, 1.6), way(0.0, 0.0, 0.05)), problem, steps=2, stride=30)
    risen = result.states[:, 2] - result.states[0, 2]
    assert 0.15 < risen[1] < 1.0
    np.testing.assert_allclose(result.states[1, :2], result.states[0, :2], atol=2e-3)
    assert 1 <= result.unreachable <= 2
    inside = run_episode(arm, Scripted(way(0.0, 0.0, 0.05)), problem, steps=1)
    assert inside.unreachable == 0


def test_a_world_model_plans_within_its_limits_and_says_why(arm: SimulatedArm) -> None:
    config = PlanningConfig(samples=8, iterations=2, limits=SMALL, planner={"name": "cem", "options": {"elites": 3}})
    policy = Planning(Controller(tiny_model(), config), name="tiny")
    reported = []
    spec = RolloutSpec("reach", DOMAIN_B, episodes=2, steps=2, films=1)
    result = run_task(spec, policy, arm, lambda *n: reported.append(n))
    assert result.policy == "tiny"
    assert result.why_counts == {"planned": 4}
    assert reported == [(decisions, 4) for decisions in range(5)]
    assert all((np.abs(episode.actions[:, :3]) <= 0.03).all() for episode in result.episodes)
    assert np.abs(result.episodes[0].actions[:, :3]).max() > 0
    assert [episode.frames is not None for episode in result.episodes] == [True, False]
    assert result.episodes[0].frames.shape == (3, 45, 80, 3)
    assert (result.seconds > 0).all()


def fake(*distances_m: float, unreachable: int = 0) -> EpisodeResult:
    count = len(distances_m)
    return EpisodeResult(
        problem=make_problem("reach", DOMAIN_A, 0, 0),
        states=np.zeros((count, 7)),
        actions=np.zeros((count - 1, 7)),
        blocks=None,
        distances_m=np.array(distances_m),
        reached=np.array(distances_m) < 0.05,
        seconds=np.arange(1.0, count),
        whys=("planned",) * (count - 2) + ("out of time",),
        unreachable=unreachable,
        goal_image=np.zeros((2, 2, 3), dtype=np.uint8),
        frames=None,
    )


def test_success_counts_at_the_end_and_passing_is_separate() -> None:
    episodes = (fake(0.04, 0.03, 0.2), fake(0.2, 0.1, 0.049), fake(0.01, 0.2, 0.051, unreachable=2))
    result = ClosedLoopResult(RolloutSpec(), "x", episodes)
    assert result.successes.tolist() == [False, True, False]
    assert result.success_rate.value == pytest.approx(1 / 3)
    assert [episode.success_ever for episode in episodes] == [True, True, False]
    assert result.success_ever_rate.value == pytest.approx(2 / 3)
    assert 0 < result.success_rate.low < 1 / 3 < result.success_rate.high < 1
    assert result.final_distance_cm.value == pytest.approx(10.0)
    assert result.final_distance_cm.low < 10.0 < result.final_distance_cm.high
    assert result.seconds_per_decision.value == pytest.approx(1.5)
    assert result.why_counts == {"planned": 3, "out of time": 3}
    assert result.unreachable.tolist() == [0, 0, 2]
    late = (fake(0.2, 0.04, 0.1, 0.03, 0.02), fake(0.2, 0.1, 0.04, 0.04, 0.04), fake(0.2, 0.01, 0.2, 0.2, 0.2))
    assert [episode.steps_needed for episode in late] == [3, 2, None], "until it is done for good"
    assert fake(0.01, 0.02).steps_needed == 0
    needed = ClosedLoopResult(RolloutSpec(), "x", late).steps_needed
    assert needed is not None
    assert needed.value == 2.5


def test_ways_are_shortened_in_their_direction_and_held_axes_left_out() -> None:
    limits = LimitsConfig(xyz=(0.05, 0.1, 0.0), rotation=0.2, gripper=0.5)
    cut = shortened(np.array([0.1, 0.1, 0.3, 0.1, 0.4, 0.0, -0.8]), limits)
    np.testing.assert_allclose(cut, [0.05, 0.05, 0.0, 0.05, 0.2, 0.0, -0.5], atol=1e-9)
    assert (np.abs(cut) <= farthest(limits)).all()
    small = np.array([0.01, 0.02, 0.0, 0.1, 0.0, 0.0, 0.1])
    np.testing.assert_array_equal(shortened(small, limits), small)
    balls = {
        norm: shortened(way(0.06, 0.08), LimitsConfig(xyz=(1, 1, 1), ball=norm, radius=0.05)) for norm in ("l1", "l2")
    }
    np.testing.assert_allclose(balls["l2"][:2], [0.03, 0.04], atol=1e-9)
    np.testing.assert_allclose(np.abs(balls["l1"]).sum(), 0.05, atol=1e-9)
    held = LimitsConfig(gripper_mode="held")
    assert shortened(np.ones(7), held)[6] == 0.0


def test_random_actions_are_those_of_the_problem_within_the_limits_and_over_all_of_them() -> None:
    policy, blank = RandomActions(LIMITS, seed=4), np.zeros((2, 2, 3), dtype=np.uint8)
    draws = []
    for index in (0, 1, 0):
        problem = make_problem("reach", DOMAIN_A, 0, index)
        policy.reset(problem, blank)
        draws.append(np.stack([policy.act(blank, problem.start) for _ in range(50)]))
    np.testing.assert_array_equal(draws[0], draws[2])
    assert (draws[0] != draws[1]).any()
    assert (np.abs(draws[0]) <= farthest(LIMITS)).all()
    assert np.abs(draws[0])[:, [0, 1, 2, 6]].max(axis=0) == pytest.approx(farthest(LIMITS)[[0, 1, 2, 6]], rel=0.2)
    assert not draws[0][:, 3:6].any()
