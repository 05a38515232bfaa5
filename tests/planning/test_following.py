"""A controller that follows goals: which one applies, what the gripper may do, and when it is done."""

import re
from pathlib import Path

import numpy as np
import pytest

from decisions import STATE, image, vector_controller
from decisions import controller as tiny_controller
from paths import ROOT
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goals import GripperMode, SubGoal, write_goals


def controller(**changes: object) -> Controller:
    return tiny_controller(seed=3, **{"horizon": 1, **changes})


def noisy(seed: int, most: int = 6) -> np.ndarray:
    """Return an image as a camera with noise sees it."""
    noise = np.random.default_rng(99).integers(-most, most + 1, (60, 48, 3))
    return (image(seed) + noise).clip(0, 255).astype(np.uint8)


def decided(run: Controller, seen: np.ndarray) -> tuple[int, int, bool, bool]:
    """Return which goal applies, since when, whether it changed, and whether all is done."""
    run.act(seen, STATE)
    return (
        run.decision.progress.place,
        run.decision.progress.since,
        bool(run.decision.progress.changed),
        run.decision.done,
    )


def test_the_next_goal_follows_once_an_image_is_near_the_present_one() -> None:
    run = controller()
    run.follow([SubGoal(image(100), at_least=2, at_most=6, share=0.5), SubGoal(image(101))])
    assert decided(run, image(0)) == (0, 0, False, False)
    assert decided(run, noisy(100)) == (0, 0, False, False), "not before its time"
    assert decided(run, image(1)) == (0, 0, False, False)
    assert decided(run, noisy(100)) == (1, 3, True, False)
    assert decided(run, image(2)) == (1, 3, False, False)
    assert run.decision.progress.began == pytest.approx(begun(run, noisy(100), 101), rel=1e-5)


def begun(run: Controller, seen: np.ndarray, goal: int) -> float:
    return float((run.encoded(seen) - run.encoded(image(goal))).abs().mean())


def test_a_noisy_image_of_the_goal_ends_it_and_what_is_done_stays_done() -> None:
    run, goals = controller(), [SubGoal(image(100), share=0.5)]
    run.follow(goals)
    assert decided(run, image(0)) == (0, 0, False, False)
    assert not run.act(noisy(100), STATE).any()
    assert (run.decision.why, run.decision.done, run.decision.plan) == ("at the goal", True, None)
    assert "below 50%" in run.decision.progress.changed
    assert not run.act(image(1), STATE).any(), "only a reset begins again"
    run.follow(goals)
    assert run.act(image(1), STATE).any()
    plain = controller()
    plain.reset(image(100))
    plain.act(image(0), STATE)
    assert plain.act(noisy(100), STATE).any(), "without the rule, only an equal image is the goal"


def test_each_goal_has_its_own_gripper_mode() -> None:
    run = controller()
    modes: list[GripperMode] = ["close", "held", "open"]
    run.follow([*(SubGoal(image(100 + n), at_most=1, gripper=mode) for n, mode in enumerate(modes)), SubGoal(image(9))])
    found = [run.act(image(seed), STATE)[6] for seed in range(4)]
    assert found[:3] == [1.0, 0.0, -1.0]
    assert float(run.space.upper[0, 6]) == pytest.approx(0.75)


def test_a_plan_looks_ahead_to_what_follows_at_the_latest() -> None:
    run = controller(horizon=6)
    bounded, unbounded = SubGoal(image(100), at_most=2, share=0.01), SubGoal(image(101), share=0.01)
    run.follow([bounded, unbounded, SubGoal(image(102), at_most=1), SubGoal(image(103))])
    found = []
    for seed in range(3):
        run.act(image(seed), STATE)
        found.append(run.decision.goals)
    assert found == [(0, 0, 1, 1, 1, 1), (0, 1, 1, 1, 1, 1), (1,) * 6], "nobody knows when the second one ends"


@pytest.mark.parametrize(
    ("goals", "wrong"),
    [
        ([SubGoal(image(100)), SubGoal(image(101))], r"goal 0: a goal that would never end"),
        ([SubGoal(image(100), at_most=3)], r"goal 0: at_most 3 of the last goal"),
        ([SubGoal(image(100), share=0.5), SubGoal(image(101)[:30])], r"goal 1: 48 x 30 pixels"),
        ([SubGoal(image(100).astype(float))], r"goal 0: .*float64"),
    ],
)  # fmt: skip
def test_goals_that_cannot_be_followed_are_refused_and_change_nothing(goals: list[SubGoal], wrong: str) -> None:
    run = controller()
    run.follow([SubGoal(image(100))])
    run.act(image(0), STATE)
    before = run.decision
    with pytest.raises(InputError, match=wrong):
        run.follow(goals)
    assert run.decision is before
    assert decided(run, image(1)) == (0, 0, False, False)
    with pytest.raises(ValueError, match="no goal"):
        run.follow([])


def test_the_pages_example_runs(tmp_path: Path) -> None:
    examples = re.findall(r"```py\n(.*?)```", (ROOT / "docs/planning.md").read_text(), flags=re.DOTALL)
    (example,) = (one for one in examples if "read_goal_folder" in one)
    write_goals(tmp_path, [SubGoal(image(100), "grasped", at_most=3), SubGoal(image(101))])
    run = controller()
    exec(  # noqa: S102 - our own page
        example.replace("goals/pick", str(tmp_path)), {"controller": run, "grasped": image(100), "placed": image(101)}
    )
    assert decided(run, image(0)) == (0, 0, False, False)
    assert decided(run, image(100)) == (1, 1, True, False), "by the share that the example gives"


def test_a_gripper_mode_needs_a_gripper_and_something_to_plan() -> None:
    run = vector_controller("difference")
    with pytest.raises(InputError, match=r"'held' of a goal: .*vectors"):
        run.follow([SubGoal(image(100), gripper="held")])
    held = controller(limits=LimitsConfig(xyz=(0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="'held' of a goal: nothing that is left to plan"):
        held.follow([SubGoal(image(100), gripper="held")])
