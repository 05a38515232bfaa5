"""The search space and the workspace: actions are clipped to the limits, and targets stay inside the box."""

import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from decisions import image, make_controller
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.search_space import SearchSpace, Workspace, is_within_limits, make_pose_search_space
from vjepa2_ac.spaces import CAMERA_POSE, POSE, make_vector_states

CORNERS = ((0.3, -0.2, 0.1), (0.6, 0.2, 0.5))
SLACK = 2e-8  # metres


def limits_of(l1: float | None = None) -> LimitsConfig:
    return LimitsConfig(workspace=CORNERS, xyz=(0.05, 0.05, 0.03), l1=l1)


def box() -> Workspace:
    return Workspace.from_limits(limits_of(), POSE)


def position(*numbers: float) -> np.ndarray:
    return np.array([*numbers, math.pi, 0.0, 0.0, 0.5])


NEAR = st.tuples(st.floats(0.27, 0.63), st.floats(-0.23, 0.23), st.floats(0.08, 0.52))


@given(NEAR, arrays(np.float64, (3, 7), elements=st.floats(-1, 1)), st.none() | st.floats(0.02, 0.1))
@example(
    (0.27, 0.0, 0.3), np.array([[-1.0, 1, 0, 0, 0, 0, 0]] * 3), 0.05
)  # outside the box, with motion along its face
def test_clipped_actions_stay_inside_the_workspace_and_limits(where, unbounded_actions, l1) -> None:
    limits, state = limits_of(l1), position(*where)
    space = make_pose_search_space(PlanningConfig(limits=limits, horizon=3))
    actions = space.clip(torch.from_numpy(unbounded_actions).float()).double().numpy()
    if not is_within_limits(box().get_return_motion(state[:3]), limits):
        return
    clipped = box().clip_actions(state, actions, limits)
    targets = state[:3] + np.cumsum(clipped[:, :3], axis=0)
    assert (targets >= np.array(CORNERS[0]) - SLACK).all()
    assert (targets <= np.array(CORNERS[1]) + SLACK).all()
    assert is_within_limits(clipped[:, :3], limits, SLACK)
    np.testing.assert_array_equal(clipped[:, 3:], actions[:, 3:])


@given(NEAR)
def test_first_decision_of_the_search_stays_inside_the_workspace(where) -> None:
    config, state = PlanningConfig(limits=limits_of(), horizon=4, action_repeat=2), position(*where)
    wide, narrow = make_pose_search_space(config), box().narrow(make_pose_search_space(config), state)
    for bound, outwards in ((narrow.upper, 1), (narrow.lower, -1)):
        ahead = state[:3] + 2 * bound[0, :3].double().numpy()
        edge = np.array(CORNERS[1] if outwards > 0 else CORNERS[0])
        assert (outwards * (ahead - np.where(outwards * (state[:3] - edge) > 0, state[:3], edge)) <= SLACK).all()
    assert (narrow.lower >= wide.lower).all()
    assert (narrow.upper <= wide.upper).all()
    assert narrow.upper[1:].equal(wide.upper[1:]), "the start positions of later decisions are unknown"


def test_robot_returns_from_slightly_outside_and_stops_far_outside() -> None:
    controller = make_controller(limits=LimitsConfig(workspace=CORNERS))
    controller.reset(image(100))
    action = controller.act(image(0), position(0.63, 0.0, 0.3))
    assert action[0] <= -0.03 + SLACK
    action = controller.act(image(1), position(0.7, 0.0, 0.3))
    assert not action.any()
    assert controller.decision.why == "outside the workspace"
    assert controller.decision.plan is None


@pytest.mark.parametrize("space", [CAMERA_POSE, make_vector_states(8)])
def test_workspace_without_base_frame_poses_raises(space) -> None:
    with pytest.raises(InputError, match="workspace: a model whose states are not poses"):
        Workspace.from_limits(limits_of(), space)
    assert Workspace.from_limits(LimitsConfig(), space) is None


@pytest.mark.parametrize("corners", [((0, 0, 0), (1, 1, 0)), ((0, 0, 0), (1, 1, math.nan)), ((0, 0, 0), (1, 1, 600))])
def test_empty_workspace_or_millimetres_raise(corners) -> None:
    with pytest.raises(ValueError, match="workspace"):
        LimitsConfig(workspace=corners)


WIDEST = (0.05, 0.03, 0.07, 0.2, 0.2, 0.2, 0.75)


def pose(horizon: int = 1, action_repeat: int = 1, **limits: object) -> SearchSpace:
    limit_values = {"xyz": WIDEST[:3], "rotation": 0.2} | limits
    return make_pose_search_space(
        PlanningConfig(horizon=horizon, action_repeat=action_repeat, limits=LimitsConfig(**limit_values))
    )


@settings(max_examples=50)
@given(
    values=st.lists(st.floats(width=32), min_size=7, max_size=7),
    l1=st.none() | st.floats(1e-3, 0.1),
)
def test_clipped_decisions_are_within_all_limits(values: list[float], l1: float | None) -> None:
    allowed = pose(l1=l1).clip(torch.tensor([values]))[0].double()
    assert torch.isfinite(allowed).all()
    assert (allowed.abs() <= torch.tensor(WIDEST, dtype=torch.float64)).all()
    assert l1 is None or allowed[:3].abs().sum() <= l1


def test_clip_keeps_allowed_actions_and_the_direction_of_longer_ones() -> None:
    inside = torch.tensor([[0.01, -0.02, 0.0, 0.1, -0.1, 0.19, -0.7]])
    assert torch.equal(pose(l1=0.031).clip(inside), inside)
    torch.testing.assert_close(pose(l1=0.015).clip(inside)[0, :3], torch.tensor([0.005, -0.01, 0.0]))


@pytest.mark.parametrize("l1", [1e-50, 0.075])
def test_zero_motion_is_allowed_with_a_finite_gradient(l1: float) -> None:
    motion = torch.zeros(2, 3, 7, requires_grad=True)
    allowed = pose(horizon=3, l1=l1).clip(motion)
    allowed.sum().backward()
    assert torch.equal(allowed, torch.zeros(2, 3, 7))
    assert torch.isfinite(motion.grad).all()


@pytest.mark.parametrize(
    ("mode", "gripper_change", "expected"),
    [
        ("rounded", 0.24, 0.0), ("rounded", -0.24, 0.0), ("rounded", 0.26, 0.26), ("rounded", 2.0, 0.75),
        ("free", 0.24, 0.24), ("held", 0.5, 0.0), ("open", 0.5, -1.0), ("close", -0.5, 1.0),
    ],
)  # fmt: skip
def test_gripper_modes_limit_and_round_the_gripper(mode: str, gripper_change: float, expected: float) -> None:
    decisions = torch.zeros(1, 7)
    decisions[0, 6] = gripper_change
    assert float(pose(gripper_mode=mode).finalize(decisions)[0, 6]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"horizon": 3, "action_repeat": 2}, "multiple of action_repeat"),
        ({"samples": 5}, "more than 5 samples"),
        ({"planner": "prior"}, "planner=prior needs prior"),
        ({"limits": {"xyz": (0.0, 0.0, 0.0), "gripper_mode": "held"}}, "nothing can be planned"),
        ({"limits": {"xyz": (50.0, 50.0, 50.0)}}, "less than or equal to 1"),  # millimetres
        ({"limits": {"rotation": 10.0}}, "less than or equal to 3.14"),  # degrees
    ],
)
def test_inconsistent_settings_raise(values: dict, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        PlanningConfig.model_validate(values)
