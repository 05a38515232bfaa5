"""Faulty frames give zero actions: frames without contrast, and frozen frames although the robot moved."""

import dataclasses
import io
import math

import numpy as np
import pytest
from PIL import Image

from decisions import QUICK, STATE, image
from decisions import make_controller as make_tiny_controller
from tiny_models import tiny_model
from vjepa2_ac.data.transforms import Crop
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import has_moved, is_uniform
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goals import make_timed_goals
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.domains import DOMAIN_A
from vjepa2_ac.spaces import POSE, apply_action

MOVED = STATE + np.eye(7)[1] * 0.0055
BLACK = np.zeros_like(image(0))


def make_controller() -> Controller:
    controller = make_tiny_controller()
    controller.reset(image(100))
    return controller


def decide_reason(controller: Controller, frame: np.ndarray, state: np.ndarray = STATE) -> str:
    """Return the reason of a decision; check that the action is zero for a faulty frame."""
    action = controller.act(frame, state)
    assert action.any() == (controller.decision.why in {"planned", "as planned"})
    return controller.decision.why


def covered_lens(noise: float, seed: int = 0) -> np.ndarray:
    """Return the image of a covered lens: dark, brighter in the middle, with the noise of a sensor, as JPEG."""
    rng, (rows, columns) = np.random.default_rng(seed), np.mgrid[-1:1:180j, -1:1:320j]
    level = 12 - 1.5 * (rows**2 + columns**2)
    pixels = np.clip(level[..., None] + rng.normal(0, noise, (180, 320, 3)), 0, 255).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=80)
    return np.asarray(Image.open(file))


def scene() -> np.ndarray:
    return SimulatedArm(DOMAIN_A).image()


@pytest.mark.parametrize("noise", [0.0, 2.0, 10.0])
def test_covered_lens_with_noise_is_a_uniform_frame(noise: float) -> None:
    assert is_uniform(covered_lens(noise))
    for level in (0, 90, 255):
        assert is_uniform(np.full((180, 320, 3), level, np.uint8))
    assert is_uniform(np.full((180, 320, 3), (0, 140, 30), np.uint8)), "the image of a failed decoder"


def test_frozen_frame_gives_zero_actions_until_the_image_changes() -> None:
    controller = make_controller()
    reasons = [
        decide_reason(controller, image(seed), state)
        for seed, state in ((0, STATE), (0, MOVED), (0, MOVED), (1, MOVED), (1, MOVED))
    ]
    assert reasons == ["planned", "frozen frame", "frozen frame", "planned", "planned"]
    assert decide_reason(controller, image(1), STATE) == "frozen frame"
    controller.reset(image(100))
    assert decide_reason(controller, image(1), STATE) == "planned", "a reset removes the previous image"


def test_reused_image_buffer_is_not_a_frozen_frame() -> None:
    controller, memory = make_controller(), image(0)
    decide_reason(controller, memory, STATE)
    memory[:] = image(1)
    assert decide_reason(controller, memory, MOVED) == "planned"


@pytest.mark.parametrize(
    ("change", "moves"),
    [
        ([0.0049, 0, 0, 0, 0, 0, 0], False), ([0.004, 0.004, 0, 0, 0, 0, 0], True),
        ([0, 0, 0, 0, 0, math.radians(2.9), 0], False), ([0, 0, 0, math.radians(-3.1), 0, 0, 0], True),
        ([0, 0, 0, 0, 0, 0, 0.9], False),
    ],
)  # fmt: skip
def test_pose_has_moved_above_half_a_centimetre_or_three_degrees(change: list[float], moves: bool) -> None:
    for state in (STATE, np.array([0.4, 0, 0.3, math.pi, 0, -math.pi, 0])):  # angles jump from pi to -pi
        assert has_moved(state, apply_action(state, np.array(change)), POSE, np.ones(7)) == moves


def test_fault_of_one_of_two_cameras_stops_the_robot() -> None:
    controller = make_tiny_controller(views=2)
    two = lambda left, right: np.hstack([image(left, 48, 48) if left else BLACK[:48, :48], image(right, 48, 48)])  # noqa: E731
    controller.reset(two(100, 101))
    assert decide_reason(controller, two(1, 2)) == "planned"
    assert decide_reason(controller, two(1, 3), MOVED) == "frozen frame"
    assert decide_reason(controller, two(4, 5), MOVED) == "planned"
    assert decide_reason(controller, two(0, 6), MOVED) == "uniform frame"
    with pytest.raises(InputError, match="goal 0: an image without contrast"):
        controller.reset(two(0, 6))


@pytest.mark.parametrize("crop", ["released", "square", "letterbox"])
def test_contrast_check_uses_only_the_cropped_image(crop: Crop) -> None:
    wide = image(100, 48, 120)
    controller = Controller(tiny_model(), QUICK, crop=crop)
    controller.reset(wide)
    edge = np.full_like(wide, 128)
    edge[:, :20] = wide[:, :20]
    assert decide_reason(controller, edge) == ("planned" if crop == "letterbox" else "uniform frame")
    assert decide_reason(controller, np.full_like(wide, 128)) == "uniform frame", (
        "the bars of a letterbox are no contrast"
    )


def test_faulty_frame_does_not_advance_the_goal() -> None:
    controller = make_controller()
    goals = [dataclasses.replace(goal, share=0.5) for goal in make_timed_goals([image(100), image(101)], [3])]
    goals[0] = dataclasses.replace(goals[0], at_least=1)
    controller.follow(goals)
    assert decide_reason(controller, BLACK) == "uniform frame"
    assert (controller.decision.goals, math.isnan(controller.decision.current_energy)) == ((0, 0), True)
    controller.act(image(1), STATE)
    began = controller.decision.progress.initial_energy
    assert began == pytest.approx(
        float((controller.encode(image(1)) - controller._goal_latents[0]).abs().mean()), rel=1e-5
    )
    for _ in range(4):
        assert decide_reason(controller, BLACK) == "uniform frame"
        assert (controller.decision.progress.goal_index, controller.decision.progress.changed) == (0, "")
    controller.act(image(2), STATE)
    assert controller.decision.progress.goal_index == 1, "the goal's steps have elapsed"
