"""Errors equal those computed by hand; shuffled actions are those of the clip before, for any batch size."""

import numpy as np
import pytest
import torch

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.metrics import (
    distances,
    measured,
    one_step_ratios,
    persistence_of,
    prediction_errors,
    ratios_by_horizon,
    with_other_actions,
)
from worlds import TIME, Copier, Oracle, clips_batch, in_batches, rows


def test_an_oracle_scores_zero_and_needs_the_true_actions() -> None:
    errors = prediction_errors(Oracle(), in_batches(clips_batch(), 4))
    assert [r.value for r in ratios_by_horizon(errors)] == pytest.approx([0.0] * (TIME - 1), abs=1e-6)
    one_step = one_step_ratios(errors)
    assert one_step["true"].value == pytest.approx(0.0, abs=1e-6)
    assert one_step["zero"].value == pytest.approx(1.0, rel=1e-6)
    assert one_step["shuffled"].value > 0.8


def test_persistence_is_exactly_one_relative_to_itself_and_blind_to_actions() -> None:
    errors = prediction_errors(Copier(), in_batches(clips_batch(), 4))
    assert all((r.value, r.low, r.high) == (1.0, 1.0, 1.0) for r in ratios_by_horizon(errors))
    assert {r.value for r in one_step_ratios(errors).values()} == {1.0}


def test_distances_equal_a_case_computed_by_hand() -> None:
    predicted = torch.tensor([[[[1.0, 0.0], [0.0, 2.0]]]])
    true = torch.tensor([[[[0.0, 1.0], [0.0, 1.0]]]])
    found = distances(predicted, true)
    assert found.l1.tolist() == [[(1 + 1 + 0 + 1) / 4]]
    assert found.l2.tolist() == [[(1 + 1 + 0 + 1) / 4]]
    assert found.cosine[0, 0] == pytest.approx((1 + 0) / 2), "at a right angle, and in line"
    assert distances(predicted * 3, predicted).cosine[0, 0] == pytest.approx(0.0, abs=1e-6), "length does not matter"
    assert distances(predicted * 3, predicted).l2.tolist() == [[(4 + 16) / 4]], "squared, no root"


def test_errors_by_horizon_equal_a_case_computed_by_hand() -> None:
    latents = torch.zeros(1, 3, 2, 2)
    latents[0, 1] = 1.0
    latents[0, 2] = torch.tensor([[3.0, 3.0], [5.0, 5.0]])
    batch = LatentBatch(latents, torch.zeros(1, 3, 7), torch.zeros(1, 2, 7), None, ("e",), (0,))
    found = measured(Copier(), batch, batch.actions)
    assert found.rollout.l1.tolist() == [[1.0, 4.0]], "from the first frame"
    assert found.teacher_forced.l1.tolist() == [[1.0, 3.0]], "from the frame before"
    assert found.rollout.l2.tolist() == [[1.0, 17.0]]
    nothing = persistence_of(batch)
    assert nothing.rollout.l1.tolist() == found.rollout.l1.tolist()
    assert nothing.teacher_forced.l2.tolist() == found.teacher_forced.l2.tolist()
    errors = prediction_errors(Copier(), [batch])
    assert errors.persistence.tolist() == [[1.0, 4.0]]
    assert errors.one_step_persistence.tolist() == [(1.0 + 3.0) / 2]
    assert errors.episode_ids == ("e",)


@pytest.mark.parametrize("size", [1, 3, 12])
def test_other_actions_are_those_of_the_clip_before_whatever_the_batch(size: int) -> None:
    batch = clips_batch()
    others = torch.cat([tried for _, tried in with_other_actions(in_batches(batch, size))])
    assert torch.equal(others, batch.actions[[1, *range(11)]]), "the first clip has those of the second"


def test_a_clip_alone_gets_its_own_actions_backwards() -> None:
    batch = rows(clips_batch(), [0])
    [(_, others)] = list(with_other_actions([batch]))
    assert torch.equal(others, batch.actions.flip(1))


def test_figures_do_not_depend_on_the_batch_size() -> None:
    small, large = (prediction_errors(Oracle(), in_batches(clips_batch(), size)) for size in (1, 12))
    for name in ("rollout", "persistence", "one_step", "one_step_zero_actions", "one_step_shuffled_actions"):
        np.testing.assert_allclose(getattr(small, name), getattr(large, name), atol=1e-6)


def test_no_clips_are_an_error() -> None:
    with pytest.raises(ValueError, match="no clips"):
        prediction_errors(Copier(), [])
