"""Decoded rollouts use only the first frame and its state; the images of a plan are its decoded predictions."""

import numpy as np
import pytest
import torch
from torch import Tensor

from decisions import image, make_plan_result
from random_decoder import write_decoder
from tiny_models import tiny_model
from vjepa2_ac.data.transforms import crop_frames, to_display_frames
from vjepa2_ac.decoding.decoder import TrainedDecoder, load_decoder
from vjepa2_ac.decoding.imagine import Start, _describe_action, compute_rollout, decode_views
from vjepa2_ac.evaluation.imagined import imagine_plan
from vjepa2_ac.planning.counterfactual import make_named_actions
from vjepa2_ac.spaces import POSE, integrate_states

STEPS, TOKENS, DIM = 4, 4, 12
STATE = np.array([0.4, 0.1, 0.3, 3.1, 0.0, -3.1, 0.9])


class RecordingModel:
    """A model that predicts the first frame again, and records its inputs."""

    def rollout(self, context: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        self.inputs = context, actions, states, extrinsics
        return context[:, -1:].expand(-1, actions.shape[1], -1, -1).clone()


def truth() -> Tensor:
    return torch.randn(STEPS + 1, TOKENS, DIM, generator=torch.Generator().manual_seed(0))


def make_start(latents: Tensor, **options: Tensor) -> Start:
    return Start(latents[0], STATE, POSE, **options)  # type: ignore[arg-type]


def test_states_of_alternative_actions_are_integrated_from_the_first_state() -> None:
    latents, model = truth(), RecordingModel()
    compute_rollout(model.rollout, make_start(latents), make_named_actions("left", STEPS, size_m=0.03))
    context, actions, states, extrinsics = model.inputs
    assert torch.equal(context, latents[None, :1]), "one frame"
    assert states.shape == actions.shape == (1, STEPS, 7)
    assert extrinsics is None
    expected = STATE + np.array([0, 0.03, 0, 0, 0, 0, 0]) * np.arange(STEPS)[:, None]
    np.testing.assert_allclose(states[0].numpy(), expected, atol=1e-6)


def test_gripper_changes_are_clipped_to_the_closedness_range() -> None:
    model = RecordingModel()
    compute_rollout(model.rollout, make_start(truth()), make_named_actions("close", STEPS))
    _, actions, states, _ = model.inputs
    np.testing.assert_allclose(actions[0, :, 6].numpy(), [0.1, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(states[0, :, 6].numpy(), [0.9, 1, 1, 1], atol=1e-6)


def test_camera_pose_of_the_first_frame_is_used_for_all_steps() -> None:
    model, camera = RecordingModel(), torch.arange(6.0)
    compute_rollout(model.rollout, make_start(truth(), extrinsics=camera), make_named_actions("none", STEPS))
    assert torch.equal(model.inputs[3], camera.expand(1, STEPS, 6))


def test_caption_has_the_unit_after_the_distances() -> None:
    assert _describe_action(np.array([0, 0.02, 0.01, 0, 0, 0, 0.5])) == "left 2.0, up 1.0 cm, close"


def test_recorded_states_are_passed_unchanged() -> None:
    model, actions = RecordingModel(), make_named_actions("up", STEPS)
    states = integrate_states(STATE, actions)[:-1] + 0.5
    compute_rollout(model.rollout, make_start(truth()), actions, states)
    np.testing.assert_allclose(model.inputs[2][0].numpy(), states, atol=1e-6)


@pytest.fixture(scope="module")
def decoder(tmp_path_factory: pytest.TempPathFactory) -> TrainedDecoder:
    return load_decoder(write_decoder(tmp_path_factory.mktemp("decoder") / "d", tiny_model()))


def test_plan_images_are_the_decoded_rollout_of_its_actions(decoder: TrainedDecoder) -> None:
    result = make_plan_result(100, 101, nodes=0, horizon=3)
    images = imagine_plan(result, decoder)
    plan, cost = result.decision.plan, result.decision.cost
    assert plan is not None
    assert cost is not None
    with torch.no_grad():
        latents, _ = cost.rollout(plan.actions[None])
    assert list(images.steps) == [1, 2, 3]
    assert np.array_equal(np.stack([*images.steps.values()]), decode_views(decoder.decoder, latents[0]))
    encoded = torch.stack([result.controller.encode(image(seed)) for seed in (0, 101)])
    assert np.array_equal(np.stack([images.start, images.decoded_goal]), decode_views(decoder.decoder, encoded))
    assert np.array_equal(images.goal, to_display_frames(crop_frames(image(101)[None]), 48)[0])


def test_long_plan_shows_eight_steps_including_the_last(decoder: TrainedDecoder) -> None:
    steps = imagine_plan(make_plan_result(nodes=0, horizon=11), decoder).steps
    assert len(steps) == 8
    assert [min(steps), max(steps)] == [1, 11]


@pytest.mark.parametrize("options", [{"start": 100}, {"broken": True}])
def test_missing_plan_or_non_finite_predictions_give_no_images(decoder: TrainedDecoder, options: dict) -> None:
    result = make_plan_result(nodes=0, **options)
    assert imagine_plan(result, decoder).steps == {}
