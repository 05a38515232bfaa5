"""The action space: allowed actions are unchanged; all others become allowed."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.planning.search_space import SearchSpace, pose_space

LIMITS = (0.05, 0.03, 0.07, 0.2, 0.2, 0.2, 0.75)


def pose(horizon: int = 1, action_repeat: int = 1, **limits: object) -> SearchSpace:
    given = {"xyz": LIMITS[:3], "rotation": 0.2} | limits
    return pose_space(PlanningConfig(horizon=horizon, action_repeat=action_repeat, limits=LimitsConfig(**given)))


@settings(max_examples=50)
@given(
    values=st.lists(st.floats(width=32), min_size=7, max_size=7),
    l1=st.none() | st.floats(1e-3, 0.1),
)
def test_allowed_actions_are_within_all_limits(values: list[float], l1: float | None) -> None:
    allowed = pose(l1=l1).allowed(torch.tensor([values]))[0].double()
    assert torch.isfinite(allowed).all()
    assert (allowed.abs() <= torch.tensor(LIMITS, dtype=torch.float64)).all()
    assert l1 is None or allowed[:3].abs().sum() <= l1


def test_actions_within_the_limits_are_unchanged_and_longer_ones_keep_their_direction() -> None:
    inside = torch.tensor([[0.01, -0.02, 0.0, 0.1, -0.1, 0.19, -0.7]])
    assert torch.equal(pose(l1=0.031).allowed(inside), inside)
    torch.testing.assert_close(pose(l1=0.015).allowed(inside)[0, :3], torch.tensor([0.005, -0.01, 0.0]))


@pytest.mark.parametrize("l1", [1e-50, 0.075])
def test_no_motion_is_allowed_under_any_limit_of_the_norm_and_has_a_finite_gradient(l1: float) -> None:
    motion = torch.zeros(2, 3, 7, requires_grad=True)
    allowed = pose(horizon=3, l1=l1).allowed(motion)
    allowed.sum().backward()
    assert torch.equal(allowed, torch.zeros(2, 3, 7))
    assert torch.isfinite(motion.grad).all()


@pytest.mark.parametrize(
    ("mode", "given", "expected"),
    [
        ("rounded", 0.24, 0.0), ("rounded", -0.24, 0.0), ("rounded", 0.26, 0.26), ("rounded", 2.0, 0.75),
        ("free", 0.24, 0.24), ("held", 0.5, 0.0), ("open", 0.5, -1.0), ("close", -0.5, 1.0),
    ],
)  # fmt: skip
def test_each_gripper_mode_does_what_it_says(mode: str, given: float, expected: float) -> None:
    decisions = torch.zeros(1, 7)
    decisions[0, 6] = given
    assert float(pose(gripper_mode=mode).finished(decisions)[0, 6]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"horizon": 3, "action_repeat": 2}, "multiple of action_repeat"),
        ({"samples": 5}, "more than 5 samples"),
        ({"limits": {"xyz": (0.0, 0.0, 0.0), "gripper_mode": "held"}}, "nothing is left"),
        ({"limits": {"xyz": (50.0, 50.0, 50.0)}}, "less than or equal to 1"),  # millimetres
        ({"limits": {"rotation": 10.0}}, "less than or equal to 3.14"),  # degrees
    ],
)
def test_settings_that_do_not_fit_are_refused(values: dict, complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        PlanningConfig.model_validate(values)
