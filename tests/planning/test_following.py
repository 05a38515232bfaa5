"""Sub-goals: which goal applies, its gripper mode, when the last goal is reached, and invariants of the rule."""

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from decisions import STATE, image, make_vector_controller
from decisions import make_controller as make_tiny_controller
from paths import ROOT
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goals import GoalProgress, GripperMode, SubGoal, write_goals


def make_controller(**changes: object) -> Controller:
    return make_tiny_controller(seed=3, **{"horizon": 1, **changes})


def noisy_image(seed: int, max_noise: int = 6) -> np.ndarray:
    """Return an image with the noise of a camera."""
    noise = np.random.default_rng(99).integers(-max_noise, max_noise + 1, (60, 48, 3))
    return (image(seed) + noise).clip(0, 255).astype(np.uint8)


def decide(controller: Controller, frame: np.ndarray) -> tuple[int, int, bool, bool]:
    """Return the goal that applies, its start step, whether it changed, and whether the last goal is reached."""
    controller.act(frame, STATE)
    return (
        controller.decision.progress.goal_index,
        controller.decision.progress.start_step,
        bool(controller.decision.progress.changed),
        controller.decision.is_done,
    )


def test_next_goal_applies_once_the_image_is_near_the_current_goal() -> None:
    controller = make_controller()
    controller.follow([SubGoal(image(100), at_least=2, at_most=6, share=0.5), SubGoal(image(101))])
    assert decide(controller, image(0)) == (0, 0, False, False)
    assert decide(controller, noisy_image(100)) == (0, 0, False, False), "not before at_least steps"
    assert decide(controller, image(1)) == (0, 0, False, False)
    assert decide(controller, noisy_image(100)) == (1, 3, True, False)
    assert decide(controller, image(2)) == (1, 3, False, False)
    assert controller.decision.progress.initial_energy == pytest.approx(
        compute_energy(controller, noisy_image(100), 101), rel=1e-5
    )


def compute_energy(controller: Controller, frame: np.ndarray, goal: int) -> float:
    return float((controller.encode(frame) - controller.encode(image(goal))).abs().mean())


def test_noisy_goal_image_reaches_the_goal_permanently() -> None:
    controller, goals = make_controller(), [SubGoal(image(100), share=0.5)]
    controller.follow(goals)
    assert decide(controller, image(0)) == (0, 0, False, False)
    assert not controller.act(noisy_image(100), STATE).any()
    assert (controller.decision.why, controller.decision.is_done, controller.decision.plan) == (
        "at the goal",
        True,
        None,
    )
    assert "below 50%" in controller.decision.progress.changed
    assert not controller.act(image(1), STATE).any(), "the goal stays reached until a reset"
    controller.follow(goals)
    assert controller.act(image(1), STATE).any()
    plain = make_controller()
    plain.reset(image(100))
    plain.act(image(0), STATE)
    assert plain.act(noisy_image(100), STATE).any(), "without share, only an equal image reaches the goal"


def test_each_goal_has_its_own_gripper_mode() -> None:
    controller = make_controller()
    modes: list[GripperMode] = ["close", "held", "open"]
    controller.follow(
        [*(SubGoal(image(100 + n), at_most=1, gripper=mode) for n, mode in enumerate(modes)), SubGoal(image(9))]
    )
    actual = [controller.act(image(seed), STATE)[6] for seed in range(4)]
    assert actual[:3] == [1.0, 0.0, -1.0]
    assert float(controller.space.upper[0, 6]) == pytest.approx(0.75)


def test_plan_includes_later_goals_at_their_latest_steps() -> None:
    controller = make_controller(horizon=6)
    bounded, unbounded = SubGoal(image(100), at_most=2, share=0.01), SubGoal(image(101), share=0.01)
    controller.follow([bounded, unbounded, SubGoal(image(102), at_most=1), SubGoal(image(103))])
    actual = []
    for seed in range(3):
        controller.act(image(seed), STATE)
        actual.append(controller.decision.goals)
    assert actual == [(0, 0, 1, 1, 1, 1), (0, 1, 1, 1, 1, 1), (1,) * 6], "the second goal has no latest step"


@pytest.mark.parametrize(
    ("goals", "wrong"),
    [
        ([SubGoal(image(100)), SubGoal(image(101))], r"goal 0: a goal without an end"),
        ([SubGoal(image(100), at_most=3)], r"goal 0: at_most 3 for the last goal"),
        ([SubGoal(image(100), share=0.5), SubGoal(image(101)[:30])], r"goal 1: 48 x 30 pixels"),
        ([SubGoal(image(100).astype(float))], r"goal 0: .*float64"),
    ],
)  # fmt: skip
def test_invalid_goals_raise_and_leave_the_controller_unchanged(goals: list[SubGoal], wrong: str) -> None:
    controller = make_controller()
    controller.follow([SubGoal(image(100))])
    controller.act(image(0), STATE)
    before = controller.decision
    with pytest.raises(InputError, match=wrong):
        controller.follow(goals)
    assert controller.decision is before
    assert decide(controller, image(1)) == (0, 0, False, False)
    with pytest.raises(ValueError, match="no goal"):
        controller.follow([])


def test_example_of_the_planning_guide_runs(tmp_path: Path) -> None:
    examples = re.findall(r"```py\n(.*?)```", (ROOT / "docs/planning.md").read_text(), flags=re.DOTALL)
    (example,) = (text for text in examples if "read_goal_folder" in text)
    write_goals(tmp_path, [SubGoal(image(100), "grasped", at_most=3), SubGoal(image(101))])
    controller = make_controller()
    exec(  # noqa: S102 - the example is part of the repository
        example.replace("goals/pick", str(tmp_path)),
        {"controller": controller, "grasped": image(100), "placed": image(101)},
    )
    assert decide(controller, image(0)) == (0, 0, False, False)
    assert decide(controller, image(100)) == (1, 1, True, False), "by the share in the example"


def test_gripper_mode_without_gripper_or_free_component_raises() -> None:
    controller = make_vector_controller("difference")
    with pytest.raises(InputError, match=r"'held' of a goal: .*vector states"):
        controller.follow([SubGoal(image(100), gripper="held")])
    controller = make_controller(limits=LimitsConfig(xyz=(0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="'held' of a goal: no free component"):
        controller.follow([SubGoal(image(100), gripper="held")])


def sub_goal(*arguments: object, **options: object) -> SubGoal:
    """Return a goal with a rule; the image is arbitrary."""
    return SubGoal(np.zeros(0), *arguments, **options)


def progress_over(rules: Sequence[SubGoal], energies: Sequence[Sequence[float]]) -> list[GoalProgress]:
    """Return the progress at each decision, from the energy of each image to each goal."""
    actual = [GoalProgress(0, 0, energies[0][0])]
    for step, row in enumerate(energies[1:], start=1):
        actual.append(actual[-1].advance(rules, step, row.__getitem__))
    return actual


numbers = st.floats(0.0, 2.0) | st.just(float("nan"))
bounds = st.tuples(st.integers(1, 4), st.integers(0, 4))


@st.composite
def goal_sequences(draw: st.DrawFn) -> tuple[list[SubGoal], list[list[float]]]:
    """Draw the rules of some goals, and the energies of more images than the goals can use."""
    intervals = draw(st.lists(st.tuples(bounds, st.none() | st.floats(0.05, 0.95)), min_size=1, max_size=4))
    rules = [sub_goal("", low, low + length, share) for (low, length), share in intervals]
    rules.append(sub_goal(share=draw(st.none() | st.floats(0.05, 0.95))))
    steps = sum(goal.at_most or 0 for goal in rules) + 3
    row = st.lists(numbers, min_size=len(rules), max_size=len(rules))
    return rules, draw(st.lists(row, min_size=steps, max_size=steps))


@given(goal_sequences())
def test_goal_index_never_decreases_and_steps_are_within_bounds(rules_and_energies: tuple) -> None:
    rules, energies = rules_and_energies
    actual = progress_over(rules, energies)
    goal_indices = [state.goal_index for state in actual]
    assert all(0 <= after - before <= 1 for before, after in pairwise(goal_indices))
    for index, goal in enumerate(rules[:-1]):
        assert goal.at_least <= goal_indices.count(index) <= goal.at_most
    assert goal_indices[-1] == len(rules) - 1, "bounded goals end after all their steps"
    for before, after in pairwise(actual):
        assert bool(after.changed) == (after.goal_index != before.goal_index or after.is_done != before.is_done)
        assert after.start_step == before.start_step or after.goal_index == before.goal_index + 1


@given(goal_sequences())
def test_goal_ends_early_only_below_its_energy_share(rules_and_energies: tuple) -> None:
    rules, energies = rules_and_energies
    actual = progress_over(rules, energies)
    for step, (before, after) in enumerate(pairwise(actual), start=1):
        goal, energy = rules[before.goal_index], energies[step][before.goal_index]
        if after.goal_index > before.goal_index:
            share = goal.share is not None and (energy < goal.share * before.initial_energy or energy <= 1e-6)
            assert share or step - before.start_step == goal.at_most
            assert after.initial_energy == pytest.approx(energies[step][after.goal_index], nan_ok=True)
        elif not before.is_done and step - before.start_step >= goal.at_least and goal.share is not None:
            reached = energy < goal.share * before.initial_energy or energy <= 1e-6
            assert after.is_done == reached


def test_initial_energy_is_measured_when_a_goal_begins() -> None:
    rules = [sub_goal("grasp", 1, 9, 0.5), sub_goal(share=0.5)]
    actual = progress_over(rules, [[1.0, 5.0], [0.6, 4.0], [0.4, 3.0], [9.0, 2.0], [9.0, 1.4], [9.0, 9.0]])
    assert [state.goal_index for state in actual] == [0, 0, 1, 1, 1, 1]
    assert [state.start_step for state in actual] == [0, 0, 2, 2, 2, 2]
    assert [state.initial_energy for state in actual] == [1.0, 1.0, 3.0, 3.0, 3.0, 3.0]
    assert [state.is_done for state in actual] == [False] * 4 + [True] * 2, "a reached goal stays reached"
    assert actual[2].changed == "Goal 1 (grasp), after 2 steps: energy 0.4 is below 50% of 1."
    assert actual[4].changed == "Goal 2, after 2 steps: energy 1.4 is below 50% of 3."
    assert not actual[5].changed


def test_nan_energy_does_not_advance_the_goal_before_at_most() -> None:
    nan = float("nan")
    rules = [sub_goal("", 1, 3, 0.5), sub_goal(share=0.5)]
    actual = progress_over(rules, [[nan, nan]] * 6)
    assert [state.goal_index for state in actual] == [0, 0, 0, 1, 1, 1]
    assert not actual[-1].is_done
