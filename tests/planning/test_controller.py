"""The controller returns actions within the limits and a reason for each image and state."""

import numpy as np
import pytest
import torch

from decisions import STATE, image, make_controller, make_vector_controller
from tiny_models import tiny_model, vector_model
from vjepa2_ac.config.planning import EnergyConfig, LimitsConfig
from vjepa2_ac.config.section import Component
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.spaces import apply_action


def actions(controller: Controller, frames: int = 3) -> np.ndarray:
    controller.reset(image(100))
    return np.stack([controller.act(image(seed), STATE) for seed in range(frames)])


def test_actions_are_within_the_limits_and_lower_the_energy() -> None:
    controller = make_controller(limits=LimitsConfig(xyz=(0.05, 0.02, 0.0)), iterations=5)
    actual = actions(controller)
    assert (np.abs(actual) <= [0.05, 0.02, 0, 0, 0, 0, 0.75]).all()
    assert actual[:, :2].all()
    assert controller.decision.why == "planned"
    with torch.no_grad():
        zero_action_energy = float(controller.decision.cost(torch.zeros(1, 2, 7)))
    assert controller.decision.plan.energy < zero_action_energy


def test_decision_contains_the_predicted_states_of_its_plan() -> None:
    controller = make_controller()
    actions(controller, 1)
    expected = [STATE]
    for action in controller.decision.plan.actions.double().numpy():
        after = apply_action(expected[-1], action)
        expected.append(np.append(after[:6], after[6].clip(0, 1)))
    np.testing.assert_allclose(controller.decision.states, expected, atol=1e-6)


@torch.no_grad()
@pytest.mark.parametrize("planner", ["cem", "gradient"])
def test_bfloat16_model_can_plan(planner: str) -> None:
    model = tiny_model().to(torch.bfloat16)
    assert actions(make_controller(model, planner=Component(planner)), 2).any()


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (image(0, 48, 60), "like the goal image"), (image(0, 60, 60), "like the goal image"),
        (image(0, 50, 48), "like the goal image"), (image(0)[..., 0], "RGB image"),
        (np.dstack([image(0), image(0)]), "RGB image"),
        (image(0).astype(np.float32), "RGB image"), (image(0)[:4, :4], "RGB image"),
    ],
)  # fmt: skip
def test_invalid_image_raises(frame: np.ndarray, message: str) -> None:
    controller = make_controller()
    controller.reset(image(100))
    with pytest.raises(InputError, match=message):
        controller.act(frame, STATE)
    with pytest.raises(InputError, match=r"goal 1.*" + message):
        controller.reset(image(100), frame, durations=(1,))


def test_act_without_a_goal_raises() -> None:
    with pytest.raises(ValueError, match="reset"):
        make_controller().act(image(0), STATE)
    with pytest.raises(ValueError, match="0 goals"):
        make_controller().reset()
    controller = make_controller()
    controller.reset(image(100))
    with pytest.raises(InputError, match="state: 6 numbers"):
        controller.act(image(0), STATE[:6])


@pytest.mark.parametrize("steps", ["last", "sum"])
def test_current_energy_is_the_distance_of_the_current_image(steps: str) -> None:
    controller = make_controller(energy=EnergyConfig(steps=steps))
    controller.reset(image(100), image(101), durations=(1,))
    controller.act(image(1), STATE)
    latents = controller.encode(image(1))
    first, second = (float((latents - goal_latents).abs().mean()) for goal_latents in controller._goal_latents)
    expected = {"last": second, "sum": first + second}[steps]
    assert controller.decision.current_energy == pytest.approx(expected, rel=1e-5)


def test_decision_can_be_repeated_after_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    undisturbed, controller = actions(make_controller()), make_controller()
    controller.reset(image(100))
    controller.act(image(0), STATE)
    for step in (1, 2):
        with monkeypatch.context() as patch:
            patch.setattr(controller.planner, "plan", fail)
            with pytest.raises(RuntimeError, match="out of memory"):
                controller.act(image(step), STATE)
        np.testing.assert_array_equal(controller.act(image(step), STATE), undisturbed[step])


def fail(*_: object) -> None:
    raise RuntimeError("out of memory")


def test_warm_start_is_the_last_plan_shifted_by_one_step(monkeypatch: pytest.MonkeyPatch) -> None:
    controller = make_controller(warm_start=True, horizon=3)
    actions(controller, 1)
    before, starts, plan = controller.decision.plan, [], controller.planner.plan
    monkeypatch.setattr(controller.planner, "plan", lambda *args: (starts.append(args[2]), plan(*args))[1])
    controller.act(image(1), STATE)
    assert torch.equal(starts[0].mean, before.mean[[1, 2, 2]])
    assert not torch.equal(before.mean[0], before.mean[1])


def test_mask_is_cropped_like_the_image_and_weights_patches() -> None:
    controller = make_controller()
    mask = np.zeros((60, 48), bool)
    mask[:20, :16] = True
    controller.reset(image(100), mask=mask)
    assert controller._patch_weights.nonzero().flatten().tolist() == [0]
    mask = np.zeros((48, 120), bool)
    mask[:16, :20] = True  # outside the crop, which is columns 27 to 91
    mask[:16, 72:] = True
    controller.reset(image(100, 48, 120), mask=mask)
    assert controller._patch_weights.nonzero().flatten().tolist() == [2]
    for wrong, message in ((np.zeros((48, 120), bool), "no pixel inside the cropped image"), (mask.T, "mask")):
        with pytest.raises(InputError, match=message):
            controller.reset(image(100, 48, 120), mask=wrong)


@pytest.mark.parametrize("joined", ["difference", "sum", "last"])
def test_model_without_state_input_plans_vectors_of_any_state_width(joined: str) -> None:
    controller, actual = make_vector_controller(joined, states=False), []
    for width in (8, 11, 3)[: 1 if joined == "last" else None]:
        controller.reset(image(100))
        actual.append([controller.act(image(seed), np.full(width, 0.1)) for seed in range(2)])
        np.testing.assert_array_equal(actual[-1], actual[0])
    assert np.shape(actual[0]) == (2, 8)
    if joined == "last":
        with pytest.raises(InputError, match="state"):
            controller.act(image(2), np.zeros(11))


def test_model_with_other_state_width_raises() -> None:
    with pytest.raises(InputError, match=r"states of 8 .* Expected states of 7 and actions of 7 numbers"):
        make_controller(vector_model(8))
