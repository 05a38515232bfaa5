"""Errors equal those computed by hand; shuffled actions are those of the clip before, for any batch size."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from vjepa2_ac import distributed
from vjepa2_ac.distributed import own_part
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.evaluate import Contender, evaluate
from vjepa2_ac.evaluation.measure import VALIDATED, actions_before, measured, prediction_errors, with_other_actions
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import ACTIONS, L1, L2, one_step_over_persistence, over_persistence
from worlds import TIME, Copier, Halfway, Oracle, about, again, clips_batch, in_batches, rows


def test_an_oracle_scores_zero_and_needs_the_true_actions() -> None:
    errors = prediction_errors(Oracle(), in_batches(clips_batch(), 4))
    assert [r.value for r in over_persistence(errors, "rollout")] == pytest.approx([0.0] * (TIME - 1), abs=1e-6)
    true, zero, shuffled = (one_step_over_persistence(errors, actions).value for actions in ACTIONS)
    assert true == pytest.approx(0.0, abs=1e-6)
    assert zero == pytest.approx(1.0, rel=1e-6)
    assert shuffled > 0.8


def test_metrics_equal_a_case_computed_by_hand() -> None:
    predicted = torch.tensor([[[[1.0, 0.0], [0.0, 2.0]]]])
    true = torch.tensor([[[[0.0, 1.0], [0.0, 1.0]]]])
    assert L1.of(predicted, true).tolist() == [[(1 + 1 + 0 + 1) / 4]]
    assert L2.of(predicted, true).tolist() == [[(1 + 1 + 0 + 1) / 4]]
    assert L2.of(predicted * 3, predicted).tolist() == [[(4 + 16) / 4]], "squared, no root"


def test_errors_by_horizon_equal_a_case_computed_by_hand() -> None:
    latents = torch.zeros(1, 3, 2, 2)
    latents[0, 1] = 1.0
    latents[0, 2] = torch.tensor([[3.0, 3.0], [5.0, 5.0]])
    batch = LatentBatch(latents, torch.zeros(1, 3, 7), torch.zeros(1, 2, 7), None, ("e",), (0,))
    found = measured(Copier(), batch, VALIDATED, (L1, L2), batch.actions)
    assert found.of("rollout").tolist() == [[1.0, 4.0]], "from the first frame"
    assert found.of("teacher_forced").tolist() == [[1.0, 3.0]], "from the frame before"
    assert found.of("rollout", L2).tolist() == [[1.0, 17.0]]
    for (way, mode, metric), values in found.arrays.items():
        assert values.tolist() == found.arrays["true", mode, metric].tolist(), way
    assert found.episode_ids == ("e",)


def test_a_validation_has_the_errors_of_an_evaluation_of_the_same_clips() -> None:
    errors = prediction_errors(Halfway(), in_batches(clips_batch(), 4))
    assert errors.arrays.keys() == {(way, mode, "l1") for way, mode in VALIDATED}
    probes = ProbeOptions(ranking_clips=0, landscape_clips=0, examples=0)
    found = evaluate([Contender("model", "trained", Halfway())], again(clips_batch()), about(), probes=probes)
    whole = found.models["model"].errors
    assert whole.episode_ids == errors.episode_ids
    for kind, values in errors.arrays.items():
        np.testing.assert_array_equal(values, whole.arrays[kind])
    asked = prediction_errors(Halfway(), in_batches(clips_batch(), 4), (L1, L2))
    assert {metric for _, _, metric in asked.arrays} == {"l1", "l2"}


@pytest.mark.parametrize("size", [1, 3, 12])
def test_other_actions_are_those_of_the_clip_before_whatever_the_batch(size: int) -> None:
    batch = clips_batch()
    others = torch.cat([tried for _, tried in with_other_actions(in_batches(batch, size))])
    assert torch.equal(others, batch.actions[[1, *range(11)]]), "the first clip has those of the second"


@pytest.mark.parametrize("processes", [2, 3, 4])
def test_processes_that_share_clips_give_each_the_same_actions_whatever_clips_are_broken(
    processes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = clips_batch()
    for whole in product([True, False], repeat=7):
        readable = [place for place in range(7) if whole[place]]

        def read(windows, readable=readable):  # type: ignore[no-untyped-def]
            return (rows(batch, [place]) for place in windows if place in readable)

        found = [torch.zeros(0, *batch.actions.shape[1:])]
        for process in range(processes):
            accelerator = SimpleNamespace(process_index=process, num_processes=processes)
            monkeypatch.setattr(distributed, "_sharing", accelerator)
            own = own_part(7, 2)
            before = actions_before(own, range(7), read)
            found += [others for _, others in with_other_actions(read(own), before)]
        alone = rows(batch, readable).actions
        expected = alone.flip(1) if len(alone) == 1 else torch.cat([alone[1:2], alone[:-1]])
        assert torch.equal(torch.cat(found), expected), whole


def test_a_clip_alone_gets_its_own_actions_backwards() -> None:
    batch = rows(clips_batch(), [0])
    [(_, others)] = list(with_other_actions([batch]))
    assert torch.equal(others, batch.actions.flip(1))
