"""Step-by-step predictions equal a rollout, and the ground truth is the recorded or simulated outcome."""

import numpy as np
import pytest
import torch

from vjepa2_ac.decoding.imagine import Start, compute_rollout
from vjepa2_ac.errors import InputError
from vjepa2_ac.explore.explorer import MAX_STEPS, Explorer, RolloutPosition
from vjepa2_ac.explore.views import Views
from vjepa2_ac.simulation.counterfactual import resimulate

UP, LEFT, CLOSE = (0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 0.0), (0.0, 0.02, 0, 0, 0, 0.05, 0), (0.0, 0, 0, 0, 0, 0, 0.75)
PATH = (UP, LEFT, CLOSE, CLOSE)


def predict_by_rollout(explorer: Explorer, model_index: int, position: RolloutPosition) -> torch.Tensor:
    first = explorer.get_observation(position.episode, position.start)
    start = Start(first.latents, first.state, explorer.spaces.state)
    with explorer.evaluated_models[model_index].prediction_context():
        return compute_rollout(explorer.get_model(model_index).rollout, start, np.array(position.actions))[-1]


def make_recorded_path(explorer: Explorer, steps: int) -> RolloutPosition:
    position = RolloutPosition(0, 0)
    for _ in range(steps):
        action = explorer.get_next_recorded_action(position)
        assert action is not None
        position = position.with_action(action)
    return position


def test_step_by_step_predictions_equal_a_rollout(recorded: Views) -> None:
    explorer, position = recorded.explorer, RolloutPosition(0, 2, PATH)
    assert [model.name for model in explorer.evaluated_models] == ["base", "adapter"]
    for model_index in range(2):
        torch.testing.assert_close(
            explorer.predict_latents(model_index, position), predict_by_rollout(explorer, model_index, position)
        )
    assert not torch.equal(explorer.predict_latents(0, position), explorer.predict_latents(1, position))


def test_prediction_does_not_depend_on_earlier_requests(recorded: Views) -> None:
    explorer, position = recorded.explorer, RolloutPosition(0, 2, PATH)
    before = explorer.predict_latents(1, position)
    explorer._cached_prediction.cache_clear()
    for other in (
        RolloutPosition(0, 2, (LEFT,)),
        RolloutPosition(0, 2, PATH[:2]),
        RolloutPosition(1, 0, PATH),
        RolloutPosition(0, 2, (*PATH[:3], UP)),
    ):
        explorer.predict_latents(1, other)
    assert torch.equal(explorer.predict_latents(1, position), before)


def test_recorded_path_has_recorded_states_and_frames(recorded: Views) -> None:
    explorer, steps = recorded.explorer, 3
    position, stride = make_recorded_path(explorer, steps), explorer.stride
    states = explorer.dataset.source.read(explorer.episodes[0]).states[: steps * stride + 1 : stride]
    np.testing.assert_allclose(explorer.integrate_states(position), states, atol=1e-6)
    true = recorded.explorer.get_true_observation(position)
    assert true is not None
    assert not true.is_simulated
    assert np.array_equal(true.pixels, explorer.get_observation(0, steps * stride).pixels)
    assert recorded.explorer.get_true_observation(position.previous.with_action(UP)) is None


def test_rounded_action_of_a_link_is_the_recorded_action(recorded: Views) -> None:
    explorer = recorded.explorer
    position = make_recorded_path(explorer, 2)
    rounded = RolloutPosition(0, 0, tuple(tuple(round(number, 5) for number in action) for action in position.actions))
    assert explorer.validate(rounded) == position
    assert explorer.validate(RolloutPosition(0, 0, (UP,))).actions == (UP,)


def test_last_step_of_an_episode_has_a_frame_but_no_action(recorded: Views) -> None:
    explorer = recorded.explorer
    last = explorer.get_num_steps(0) - 1
    assert explorer.get_observation(0, last).action is None
    assert np.array_equal(
        explorer.get_observation(0, last - explorer.stride).pixels, explorer._cached_pair(0, last - 2)[0].pixels
    )
    position = RolloutPosition(0, last - explorer.stride)
    action = explorer.get_next_recorded_action(position)
    assert action is not None
    assert explorer.get_next_recorded_action(position.with_action(action)) is None
    assert explorer.get_recorded_observation(position.with_action(action)) is not None


def test_simulated_ground_truth_does_not_depend_on_earlier_requests(live: Views) -> None:
    explorer, position = live.explorer, RolloutPosition(0, 4, (UP, LEFT, UP))
    folder = explorer.dataset.config.path
    arm = resimulate(folder, explorer.dataset.source.read(explorer.episodes[0]), 4)
    expected = arm.simulate(np.array(position.actions), explorer.stride)
    for before in ((), (LEFT,), (UP, LEFT), (UP, LEFT, UP, LEFT)):
        live.explorer.get_true_observation(RolloutPosition(0, 4, before))
        true = live.explorer.get_true_observation(position)
        assert true is not None
        assert true.is_simulated
        np.testing.assert_array_equal(true.state, expected.states[-1])


def test_unreachable_target_is_reported(live: Views) -> None:
    true = live.explorer.get_true_observation(RolloutPosition(0, 4, ((0.9, 0.0, 0.0, 0, 0, 0, 0),) * 2))
    assert true is not None
    assert not true.has_reached_target


@pytest.mark.parametrize(
    ("position", "message"),
    [
        (RolloutPosition(99, 0), "episode 99"),
        (RolloutPosition(0, 10_000), "control step 10000"),
        (RolloutPosition(0, 0, ((1.0,),)), "1 numbers"),
        (RolloutPosition(0, 0, ((50.0, 0, 0, 0, 0, 0, 0),)), "in metres, radians and gripper position"),
        (RolloutPosition(0, 0, (UP,) * (MAX_STEPS + 1)), f"at most {MAX_STEPS}"),
    ],
)
def test_invalid_position_raises(recorded: Views, position: RolloutPosition, message: str) -> None:
    with pytest.raises(InputError, match=message):
        recorded.explorer.validate(position)
