"""The images of a plan are those of the rollout that it was chosen by."""

import numpy as np
import pytest
import torch

from decisions import asked, image
from random_decoder import write_decoder
from tiny_models import tiny_model
from vjepa2_ac.data.transforms import frames_as_seen, view
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder, load_decoder
from vjepa2_ac.decoding.imagine import shown
from vjepa2_ac.decoding.imagined_plan import imagine_plan, imagined_next


@pytest.fixture(scope="module")
def decoder(tmp_path_factory: pytest.TempPathFactory) -> TrainedDecoder:
    return load_decoder(write_decoder(tmp_path_factory.mktemp("decoder") / "d", tiny_model()))


def test_the_imagined_steps_are_the_decoded_rollout_of_the_chosen_actions(decoder: TrainedDecoder) -> None:
    answer = asked(100, 101, nodes=0, horizon=3)
    found = imagine_plan(answer, decoder)
    plan, cost = answer.decision.plan, answer.decision.cost
    assert plan is not None
    assert cost is not None
    with torch.no_grad():
        latents, _ = cost.imagine(plan.actions[None])
    assert list(found.steps) == [1, 2, 3]
    assert np.array_equal(np.stack([*found.steps.values()]), shown(decoder.decoder, latents[0]))
    encoded = torch.stack([answer.controller.encoded(image(seed)) for seed in (0, 101)])
    assert np.array_equal(np.stack([found.start, found.decoded_goal]), shown(decoder.decoder, encoded))
    assert np.array_equal(found.goal, frames_as_seen(view(image(101)[None]), 48)[0])


def test_of_a_long_plan_eight_steps_are_shown_the_end_among_them(decoder: TrainedDecoder) -> None:
    steps = imagine_plan(asked(nodes=0, horizon=11), decoder).steps
    assert len(steps) == 8
    assert [min(steps), max(steps)] == [1, 11]


@pytest.mark.parametrize("answer", [{"start": 100}, {"broken": True}])
def test_without_a_plan_or_finite_predictions_nothing_is_imagined(decoder: TrainedDecoder, answer: dict) -> None:
    answer = asked(nodes=0, **answer)
    assert imagine_plan(answer, decoder).steps == {}
    assert imagined_next(answer.decision, decoder) is None


def test_the_next_frame_is_the_first_step_of_the_plan(decoder: TrainedDecoder) -> None:
    answer = asked(nodes=0)
    following = imagined_next(answer.decision, decoder)
    assert following is not None
    difference = following.astype(int) - imagine_plan(answer, decoder).steps[1]
    assert abs(difference).max() <= 1
