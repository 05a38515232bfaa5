"""A step of imagination is a rollout's, whatever was looked at before; and the truth beside it is what happens."""

import numpy as np
import pytest
import torch

from vjepa2_ac.decoding.imagine import Start, rolled_out
from vjepa2_ac.errors import InputError
from vjepa2_ac.explore.explorer import MOST_STEPS, Explorer, Place
from vjepa2_ac.explore.views import Views
from vjepa2_ac.simulation.counterfactual import resimulate

UP, LEFT, CLOSE = (0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 0.0), (0.0, 0.02, 0, 0, 0, 0.05, 0), (0.0, 0, 0, 0, 0, 0, 0.75)
PATH = (UP, LEFT, CLOSE, CLOSE)


def rollout(explorer: Explorer, teller: int, place: Place) -> torch.Tensor:
    first = explorer.moment(place.episode, place.start)
    start = Start(first.latents, first.state, explorer.spaces.state)
    with explorer.evaluated_models[teller].prediction_context():
        return rolled_out(explorer.model(teller).rollout, start, np.array(place.actions))[-1]


def recorded_path(explorer: Explorer, steps: int) -> Place:
    place = Place(0, 0)
    for _ in range(steps):
        action = explorer.recorded_next(place)
        assert action is not None
        place = place.after(action)
    return place


def test_steps_one_by_one_are_a_rollout_of_base_and_adapter(recorded: Views) -> None:
    explorer, place = recorded.explorer, Place(0, 2, PATH)
    assert [one.name for one in explorer.evaluated_models] == ["base", "adapter"]
    for teller in range(2):
        torch.testing.assert_close(explorer.imagined(teller, place), rollout(explorer, teller, place))
    assert not torch.equal(explorer.imagined(0, place), explorer.imagined(1, place))


def test_what_was_looked_at_before_changes_nothing(recorded: Views) -> None:
    explorer, place = recorded.explorer, Place(0, 2, PATH)
    before = explorer.imagined(1, place)
    explorer._end.cache_clear()
    for other in (Place(0, 2, (LEFT,)), Place(0, 2, PATH[:2]), Place(1, 0, PATH), Place(0, 2, (*PATH[:3], UP))):
        explorer.imagined(1, other)
    assert torch.equal(explorer.imagined(1, place), before)


def test_the_recorded_way_has_recorded_states_and_the_true_frame(recorded: Views) -> None:
    explorer, steps = recorded.explorer, 3
    place, stride = recorded_path(explorer, steps), explorer.stride
    states = explorer.dataset.source.read(explorer.episodes[0]).states[: steps * stride + 1 : stride]
    np.testing.assert_allclose(explorer.states(place), states, atol=1e-6)
    true = recorded.explorer.truth(place)
    assert true is not None
    assert not true.is_simulated
    assert np.array_equal(true.pixels, explorer.moment(0, steps * stride).pixels)
    assert recorded.explorer.truth(place.before.after(UP)) is None


def test_a_link_with_rounded_numbers_means_the_recorded_action(recorded: Views) -> None:
    explorer = recorded.explorer
    place = recorded_path(explorer, 2)
    rounded = Place(0, 0, tuple(tuple(round(number, 5) for number in action) for action in place.actions))
    assert explorer.require(rounded) == place
    assert explorer.require(Place(0, 0, (UP,))).actions == (UP,)


def test_the_end_of_an_episode_has_a_frame_and_no_further_action(recorded: Views) -> None:
    explorer = recorded.explorer
    last = explorer.steps(0) - 1
    assert explorer.moment(0, last).action is None
    assert np.array_equal(explorer.moment(0, last - explorer.stride).pixels, explorer._pair(0, last - 2)[0].pixels)
    place = Place(0, last - explorer.stride)
    action = explorer.recorded_next(place)
    assert action is not None
    assert explorer.recorded_next(place.after(action)) is None
    assert explorer.recorded(place.after(action)) is not None


def test_the_simulated_truth_is_what_happens_whatever_was_done_before(live: Views) -> None:
    explorer, place = live.explorer, Place(0, 4, (UP, LEFT, UP))
    folder = explorer.dataset.config.path
    arm = resimulate(folder, explorer.dataset.source.read(explorer.episodes[0]), 4)
    expected = arm.simulate(np.array(place.actions), explorer.stride)
    for before in ((), (LEFT,), (UP, LEFT), (UP, LEFT, UP, LEFT)):
        live.explorer.truth(Place(0, 4, before))
        true = live.explorer.truth(place)
        assert true is not None
        assert true.is_simulated
        np.testing.assert_array_equal(true.state, expected.states[-1])


def test_a_target_out_of_reach_is_said(live: Views) -> None:
    true = live.explorer.truth(Place(0, 4, ((0.9, 0.0, 0.0, 0, 0, 0, 0),) * 2))
    assert true is not None
    assert not true.reached


@pytest.mark.parametrize(
    ("place", "says"),
    [
        (Place(99, 0), "episode: 99"),
        (Place(0, 10_000), "control step 10000"),
        (Place(0, 0, ((1.0,),)), "1 numbers"),
        (Place(0, 0, ((50.0, 0, 0, 0, 0, 0, 0),)), "in metres, radians and closedness"),
        (Place(0, 0, (UP,) * (MOST_STEPS + 1)), f"at most {MOST_STEPS}"),
    ],
)
def test_what_is_no_place_is_refused(recorded: Views, place: Place, says: str) -> None:
    with pytest.raises(InputError, match=says):
        recorded.explorer.require(place)
