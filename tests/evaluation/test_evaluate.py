"""An oracle has error 0, a copier equals persistence and ignores its actions; errors equal those computed by hand."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from vjepa2_ac import distributed
from vjepa2_ac.distributed import own_share
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.evaluate import EvaluatedModel, describe_clips, evaluate
from vjepa2_ac.evaluation.measure import (
    VALIDATION_PREDICTIONS,
    measure_errors,
    prediction_errors,
    previous_clip_actions,
    with_shuffled_actions,
)
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import (
    L1,
    L2,
    MODES,
    Clips,
    Evaluation,
    PredictionErrors,
    gain_over,
    gap_of_actions,
    one_step_over_persistence,
    over_persistence,
)
from vjepa2_ac.evaluation.rows import make_rows
from vjepa2_ac.evaluation.summary import summarize
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.reports.metrics_json import metrics_as_dict
from vjepa2_ac.spaces import POSE_CHANGE, ActionSpace, make_vector_actions
from worlds import DIM, TIME, Copier, Halfway, Oracle, about, again, clips_batch, in_batches, rows

PROBES = ProbeOptions(ranking_clips=6, samples=20, landscape_clips=3, nodes=5, examples=3, at_once=7)


def evaluated(trained: object, base: object | None = None, *, size: int = 4, **changes: object) -> Evaluation:
    evaluated_models = [] if base is None else [EvaluatedModel("base", "base", base)]  # type: ignore[arg-type]
    evaluated_models.append(EvaluatedModel("adapter", "trained", trained))  # type: ignore[arg-type]
    batch = clips_batch(actions=changes.pop("actions", None))  # type: ignore[arg-type]
    return evaluate(evaluated_models, again(batch, size), about(**changes), probes=PROBES)


def pair_of(found: Evaluation) -> tuple[PredictionErrors, PredictionErrors]:
    return found.models["adapter"].errors, found.models["base"].errors


@pytest.fixture(scope="module")
def oracle() -> Evaluation:
    return evaluated(Oracle(), Copier())


def test_a_perfect_predictor_scores_zero_in_every_metric(oracle: Evaluation) -> None:
    for mode in MODES:
        for metric in (L1, L2):
            for one in over_persistence(oracle.models["adapter"].errors, mode, metric):
                assert one.value == pytest.approx(0.0, abs=1e-5)
    assert [one.value for one in gain_over(*pair_of(oracle))] == pytest.approx([1.0] * (TIME - 1))
    found = summarize(oracle, make_rows(oracle))
    assert found.prediction.statement.startswith("error 100 % lower than the base model's")
    assert found.sensitivity.conclusion == "yes"


def test_spread_and_mmd_equal_those_of_the_predicted_latents() -> None:
    found = evaluated(Halfway(), Oracle())
    batch = clips_batch()
    predicted = Halfway().rollout(batch.latents[:, :1], batch.actions, batch.states)
    kinds = predicted, batch.latents[:, 1:], batch.latents[:, :1]
    traces = [values.double().var(dim=0, correction=0).sum(dim=(1, 2)) for values in kinds]
    models = {name: model.distribution for name, model in found.models.items()}
    assert [one.value for one in models["adapter"].spread] == pytest.approx((traces[0] / traces[1]).tolist(), rel=1e-5)
    assert [one.value for one in models["base"].spread] == pytest.approx([1.0] * (TIME - 1))
    assert [one.value for one in models["base"].mmd] == pytest.approx([0.0] * (TIME - 1), abs=1e-9)
    assert [one.value for one in found.copies.spread] == pytest.approx((traces[2] / traces[1]).tolist(), rel=1e-5)
    assert models["base"].fvd == pytest.approx(0.0, abs=1e-6)
    assert models["adapter"].fvd > 0


def test_a_model_that_ignores_actions_has_the_action_ranking_error_of_chance() -> None:
    found = evaluated(Copier())
    ranking = found.models["adapter"].ranking
    assert ranking is not None
    assert ranking.change == Estimate(0.0, 0.0, 0.0)
    assert set(ranking.ranks) == {0.5}
    assert gap_of_actions(found.models["adapter"].errors, "shuffled") == Estimate(0.0, 0.0, 0.0)
    assert summarize(found, make_rows(found)).sensitivity.conclusion == "no"


def test_paired_difference_equals_manual_computation() -> None:
    found = evaluated(Halfway(), Copier())
    errors, base = pair_of(found)
    assert [one.value for one in over_persistence(errors, "teacher_forced")] == pytest.approx([0.5] * 4)
    assert [one.value for one in over_persistence(errors, "rollout", L2)] == pytest.approx([0.25] * 4)
    gains = gain_over(errors, base)
    assert [(one.low, one.value, one.high) for one in gains] == [pytest.approx((0.5, 0.5, 0.5))] * 4


def test_errors_with_wrong_actions_equal_direct_predictions(oracle: Evaluation) -> None:
    errors = oracle.models["adapter"].errors
    zero = over_persistence(errors, "teacher_forced", actions="zero")
    assert [one.value for one in zero] == pytest.approx([1.0] * (TIME - 1), rel=1e-5), "nothing done, nothing moves"
    batch = clips_batch()
    others = batch.actions[[1, *range(11)]]
    expected = (others - batch.actions)[..., :DIM].abs().mean(dim=(0, 2)) * 100
    shuffled = errors.of("teacher_forced", actions="shuffled").mean(axis=0)
    assert shuffled.tolist() == pytest.approx(expected.tolist(), rel=1e-4)


def test_only_selected_steps_are_averaged(oracle: Evaluation) -> None:
    first = np.zeros((12, TIME - 1), bool)
    first[:, 0] = True
    errors = oracle.models["adapter"].errors
    nothing = errors.of("teacher_forced", actions="persistence")
    made_up = np.where(first, 2 * nothing, nothing / 4)
    errors = replace(errors, arrays={**errors.arrays, ("true", "teacher_forced", "l1"): made_up})
    for steps, value in ((first, 2.0), (~first, 0.25)):
        assert one_step_over_persistence(errors, "true", steps).value == pytest.approx(value)


def test_same_seed_gives_equal_metrics_file_and_another_seed_other_actions(oracle: Evaluation) -> None:
    assert metrics_as_dict(evaluated(Oracle(), Copier())) == metrics_as_dict(oracle)
    first, second = (found.models["adapter"].ranking for found in (oracle, evaluated(Oracle(), seed=1)))
    assert first is not None
    assert second is not None
    assert first.change != second.change


def test_examples_are_best_worst_and_most_motion_clips() -> None:
    found = evaluated(Halfway(), Copier())
    reasons = " ".join(example.why for example in found.examples)
    assert "most motion" in reasons
    assert "best" in reasons
    for example in found.examples:
        assert example.frames is not None
        assert example.frames.shape == (TIME, 8, 8, 3)
        assert list(example.errors) == ["persistence", "base", "adapter"]
        np.testing.assert_allclose(example.errors["base"], example.errors["persistence"])
        np.testing.assert_allclose(example.errors["adapter"], example.errors["base"] / 2, rtol=1e-3)


def test_vector_actions_have_no_unit_and_short_ones_no_landscape() -> None:
    evaluated_models = [EvaluatedModel("model", "trained", Oracle())]
    vectors, narrow = (
        evaluate(
            evaluated_models,
            again(clips_batch(width=width), space=make_vector_actions(width, "change")),
            about(),
            probes=PROBES,
        )
        for width in (4, 2)
    )
    landscapes = vectors.models["model"].landscapes
    assert landscapes is not None
    assert (landscapes.unit, landscapes.axis_names[0]) == ("", "action 0")
    assert narrow.models["model"].landscapes is None
    assert "an action has 2 numbers" in narrow.notes[0]
    json.dumps(metrics_as_dict(narrow), allow_nan=False)


def test_each_model_predicts_within_its_prediction_context() -> None:
    on: list[str] = []

    @contextmanager
    def switch() -> Iterator[None]:
        on.append("base")
        yield
        on.pop()

    class Watched(Copier):
        def predict(self, *inputs, **more):  # type: ignore[no-untyped-def]
            assert on == ["base"]
            return super().predict(*inputs, **more)

    class Unwatched(Oracle):
        def predict(self, *inputs, **more):  # type: ignore[no-untyped-def]
            assert not on
            return super().predict(*inputs, **more)

    evaluated_models = [
        EvaluatedModel("base", "base", Watched(), switch),
        EvaluatedModel("adapter", "trained", Unwatched()),
    ]
    evaluate(evaluated_models, again(clips_batch()), about(), probes=PROBES)


# ---- which steps move ----


def of(*actions: list[float], space: ActionSpace = POSE_CHANGE) -> Clips:
    steps = np.array(actions)[None]
    return describe_clips(steps, [("a", 0)], space=space, seconds_per_step=0.5)


@pytest.mark.parametrize(
    ("action", "moves"),
    [
        ([0.0] * 7, False),
        ([0.009, 0, 0, 0, 0, 0, 0], False),  # 1.8 cm/s
        ([0.0, 0.008, 0.008, 0, 0, 0, 0], True),  # 2.26 cm/s
        ([0, 0, 0, 0, 0, 0.08, 0], False),  # 9.2 degrees/s
        ([0, 0, 0, 0.1, 0, 0, 0], True),  # 11.5 degrees/s
        ([0, 0, 0, 0, 0, 0, -0.06], True),
        ([0, 0, 0, 0, 0, 0, 0.04], False),
    ],
)
def test_step_counts_as_moving_if_hand_translates_rotates_or_grips(action: list[float], moves: bool) -> None:
    clips = of(action)
    assert clips.moving.tolist() == [[moves]]
    assert clips.action_size[0, 0] == pytest.approx(np.linalg.norm(action[:3]) * 100)


def test_moving_steps_of_vectors_are_relative_to_their_largest_actions() -> None:
    clips = of([1.0, 0.0], [0.05, 0.0], [0.0, 0.2], [0.0, 0.0], space=make_vector_actions(2, "change"))
    assert clips.moving.tolist() == [[True, False, True, False]]
    assert not of([0.0, 0.0], space=make_vector_actions(2, "change")).moving.any(), "nothing at all is no motion"


# ---- errors, and actions of other clips ----


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
    found = measure_errors(Copier(), batch, VALIDATION_PREDICTIONS, (L1, L2), batch.actions)
    assert found.of("rollout").tolist() == [[1.0, 4.0]], "from the first frame"
    assert found.of("teacher_forced").tolist() == [[1.0, 3.0]], "from the frame before"
    assert found.of("rollout", L2).tolist() == [[1.0, 17.0]]
    for (actions, mode, metric), values in found.arrays.items():
        assert values.tolist() == found.arrays["true", mode, metric].tolist(), actions
    assert found.episode_ids == ("e",)


def test_a_validation_has_the_errors_of_an_evaluation_of_the_same_clips() -> None:
    errors = prediction_errors(Halfway(), in_batches(clips_batch(), 4))
    assert errors.arrays.keys() == {(actions, mode, "l1") for actions, mode in VALIDATION_PREDICTIONS}
    probes = ProbeOptions(ranking_clips=0, landscape_clips=0, examples=0)
    found = evaluate([EvaluatedModel("model", "trained", Halfway())], again(clips_batch()), about(), probes=probes)
    whole = found.models["model"].errors
    assert whole.episode_ids == errors.episode_ids
    for kind, values in errors.arrays.items():
        np.testing.assert_array_equal(values, whole.arrays[kind])
    asked = prediction_errors(Halfway(), in_batches(clips_batch(), 4), (L1, L2))
    assert {metric for _, _, metric in asked.arrays} == {"l1", "l2"}


@pytest.mark.parametrize("size", [1, 3, 12])
def test_shuffled_actions_are_those_of_the_previous_clip_for_any_batch_size(size: int) -> None:
    batch = clips_batch()
    others = torch.cat([tried for _, tried in with_shuffled_actions(in_batches(batch, size))])
    assert torch.equal(others, batch.actions[[1, *range(11)]]), "the first clip has those of the second"


@pytest.mark.parametrize("processes", [2, 3, 4])
def test_shuffled_actions_do_not_depend_on_number_of_processes(processes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = clips_batch()
    for whole in product([True, False], repeat=7):
        readable = [place for place in range(7) if whole[place]]

        def read(windows, readable=readable):  # type: ignore[no-untyped-def]
            return (rows(batch, [place]) for place in windows if place in readable)

        found = [torch.zeros(0, *batch.actions.shape[1:])]
        for process in range(processes):
            accelerator = SimpleNamespace(process_index=process, num_processes=processes)
            monkeypatch.setattr(distributed, "_sharing", accelerator)
            own = own_share(7, 2)
            before = previous_clip_actions(own, range(7), read)
            found += [others for _, others in with_shuffled_actions(read(own), before)]
        alone = rows(batch, readable).actions
        expected = alone.flip(1) if len(alone) == 1 else torch.cat([alone[1:2], alone[:-1]])
        assert torch.equal(torch.cat(found), expected), whole


def test_single_clip_gets_its_reversed_actions() -> None:
    batch = rows(clips_batch(), [0])
    [(_, others)] = list(with_shuffled_actions([batch]))
    assert torch.equal(others, batch.actions.flip(1))
