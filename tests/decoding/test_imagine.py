"""Imagination is given one frame and its state, and nothing of what happened after."""

import numpy as np
import torch
from torch import Tensor

from vjepa2_ac.decoding.imagine import Start, imagined_latents, rolled_out
from vjepa2_ac.planning.counterfactual import counterfactual_states, named_actions
from vjepa2_ac.spaces import POSE

STEPS, TOKENS, DIM = 4, 4, 12
STATE = np.array([0.4, 0.1, 0.3, 3.1, 0.0, -3.1, 0.9])


class Remembering:
    """A model that answers with given latents, and remembers what it was given."""

    def __init__(self, answer: Tensor | None = None) -> None:
        self.answer = answer

    def rollout(self, context: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        self.given = context, actions, states, extrinsics
        answer = context[:, -1:].expand(-1, actions.shape[1], -1, -1) if self.answer is None else self.answer[None]
        return answer.clone()


def truth() -> Tensor:
    return torch.randn(STEPS + 1, TOKENS, DIM, generator=torch.Generator().manual_seed(0))


def start_of(latents: Tensor, **more: Tensor) -> Start:
    return Start(latents[0], STATE, POSE, **more)  # type: ignore[arg-type]


def test_states_under_other_actions_are_integrated_from_the_first_one() -> None:
    latents, model = truth(), Remembering()
    imagined_latents(model, start_of(latents), named_actions("left", STEPS, size_m=0.03))
    context, actions, states, extrinsics = model.given
    assert torch.equal(context, latents[None, :1]), "one frame"
    assert states.shape == actions.shape == (1, STEPS, 7)
    assert extrinsics is None
    expected = STATE + np.array([0, 0.03, 0, 0, 0, 0, 0]) * np.arange(STEPS)[:, None]
    np.testing.assert_allclose(states[0].numpy(), expected, atol=1e-6)


def test_a_gripper_changes_as_far_as_it_can() -> None:
    model = Remembering()
    imagined_latents(model, start_of(truth()), named_actions("close", STEPS))
    _, actions, states, _ = model.given
    np.testing.assert_allclose(actions[0, :, 6].numpy(), [0.1, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(states[0, :, 6].numpy(), [0.9, 1, 1, 1], atol=1e-6)


def test_the_camera_of_the_first_frame_holds_for_all_steps() -> None:
    model, camera = Remembering(), torch.arange(6.0)
    imagined_latents(model, start_of(truth(), extrinsics=camera), named_actions("none", STEPS))
    assert torch.equal(model.given[3], camera.expand(1, STEPS, 6))


def test_known_states_are_given_as_they_are() -> None:
    model, actions = Remembering(), named_actions("up", STEPS)
    states = counterfactual_states(STATE, actions)[:-1] + 0.5
    rolled_out(model, start_of(truth()), actions, states)
    np.testing.assert_allclose(model.given[2][0].numpy(), states, atol=1e-6)
