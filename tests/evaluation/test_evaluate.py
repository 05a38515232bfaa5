"""Errors equal values computed by hand: 0 for an oracle, those of persistence for a model that copies frames."""

import json
from collections.abc import Iterable, Iterator
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
from worlds import DIM, TIME, Copier, Halfway, Oracle, about, clips_batch, in_batches, repeatable_clips, rows

PROBES = ProbeOptions(ranking_clips=6, samples=20, landscape_clips=3, nodes=5, examples=3, at_once=7)


def evaluated(trained: object, base: object | None = None, *, size: int = 4, **changes: object) -> Evaluation:
    evaluated_models = [] if base is None else [EvaluatedModel("base", "base", base)]  # type: ignore[arg-type]
    evaluated_models.append(EvaluatedModel("adapter", "trained", trained))  # type: ignore[arg-type]
    batch = clips_batch(actions=changes.pop("actions", None))  # type: ignore[arg-type]
    return evaluate(evaluated_models, repeatable_clips(batch, size), about(**changes), probes=PROBES)


def adapter_and_base_errors(evaluation: Evaluation) -> tuple[PredictionErrors, PredictionErrors]:
    return evaluation.models["adapter"].errors, evaluation.models["base"].errors


def values_of(estimates: Iterable[Estimate]) -> list[float]:
    return [estimate.value for estimate in estimates]


@pytest.fixture(scope="module")
def oracle() -> Evaluation:
    return evaluated(Oracle(), Copier())


def test_a_perfect_predictor_scores_zero_in_every_metric(oracle: Evaluation) -> None:
    for mode in MODES:
        for metric in (L1, L2):
            for ratio in over_persistence(oracle.models["adapter"].errors, mode, metric):
                assert ratio.value == pytest.approx(0.0, abs=1e-5)
    assert [gain.value for gain in gain_over(*adapter_and_base_errors(oracle))] == pytest.approx([1.0] * (TIME - 1))
    summary = summarize(oracle, make_rows(oracle))
    assert summary.prediction.statement.startswith("1.0 s ahead, error 100 % lower than the base model's")
    assert summary.sensitivity.conclusion == "yes"


def test_spread_and_mmd_equal_those_of_the_predicted_latents() -> None:
    evaluation = evaluated(Halfway(), Oracle())
    batch = clips_batch()
    predicted = Halfway().rollout(batch.latents[:, :1], batch.actions, batch.states)
    latents = predicted, batch.latents[:, 1:], batch.latents[:, :1]
    traces = [values.double().var(dim=0, correction=0).sum(dim=(1, 2)) for values in latents]
    models = {name: model.distribution for name, model in evaluation.models.items()}
    assert values_of(models["adapter"].spread) == pytest.approx((traces[0] / traces[1]).tolist(), rel=1e-5)
    assert values_of(models["base"].spread) == pytest.approx([1.0] * (TIME - 1))
    assert values_of(models["base"].mmd) == pytest.approx([0.0] * (TIME - 1), abs=1e-9)
    assert values_of(evaluation.copies.spread) == pytest.approx((traces[2] / traces[1]).tolist(), rel=1e-5)
    assert models["base"].fvd == pytest.approx(0.0, abs=1e-6)
    assert models["adapter"].fvd > 0


def test_a_model_that_ignores_actions_has_the_action_ranking_error_of_chance() -> None:
    evaluation = evaluated(Copier())
    ranking = evaluation.models["adapter"].ranking
    assert ranking is not None
    assert ranking.change == Estimate(0.0, 0.0, 0.0)
    assert set(ranking.ranks) == {0.5}
    assert gap_of_actions(evaluation.models["adapter"].errors, "shuffled") == Estimate(0.0, 0.0, 0.0)
    assert summarize(evaluation, make_rows(evaluation)).sensitivity.conclusion == "no"


def test_ratios_and_gains_of_a_model_that_predicts_half_the_motion_equal_manual_computation() -> None:
    evaluation = evaluated(Halfway(), Copier())
    errors, base = adapter_and_base_errors(evaluation)
    assert values_of(over_persistence(errors, "teacher_forced")) == pytest.approx([0.5] * 4)
    assert values_of(over_persistence(errors, "rollout", L2)) == pytest.approx([0.25] * 4)
    gains = gain_over(errors, base)
    assert [(estimate.low, estimate.value, estimate.high) for estimate in gains] == [pytest.approx((0.5, 0.5, 0.5))] * 4


def test_errors_with_wrong_actions_equal_direct_predictions(oracle: Evaluation) -> None:
    errors = oracle.models["adapter"].errors
    zero = over_persistence(errors, "teacher_forced", actions="zero")
    assert values_of(zero) == pytest.approx([1.0] * (TIME - 1), rel=1e-5), "no action, no predicted motion"
    batch = clips_batch()
    shuffled_actions = batch.actions[[1, *range(11)]]
    expected = (shuffled_actions - batch.actions)[..., :DIM].abs().mean(dim=(0, 2)) * 100
    shuffled = errors.of("teacher_forced", actions="shuffled").mean(axis=0)
    assert shuffled.tolist() == pytest.approx(expected.tolist(), rel=1e-4)


def test_only_selected_steps_are_averaged(oracle: Evaluation) -> None:
    first = np.zeros((12, TIME - 1), bool)
    first[:, 0] = True
    errors = oracle.models["adapter"].errors
    persistence = errors.of("teacher_forced", actions="persistence")
    values = np.where(first, 2 * persistence, persistence / 4)
    errors = replace(errors, arrays={**errors.arrays, ("true", "teacher_forced", "l1"): values})
    for steps, value in ((first, 2.0), (~first, 0.25)):
        assert one_step_over_persistence(errors, "true", steps).value == pytest.approx(value)


def test_same_seed_gives_equal_metrics_and_another_seed_other_alternative_actions(oracle: Evaluation) -> None:
    assert metrics_as_dict(evaluated(Oracle(), Copier())) == metrics_as_dict(oracle)
    first, second = (result.models["adapter"].ranking for result in (oracle, evaluated(Oracle(), seed=1)))
    assert first is not None
    assert second is not None
    assert first.change != second.change


def test_examples_have_reasons_frames_and_the_errors_of_each_model() -> None:
    evaluation = evaluated(Halfway(), Copier())
    reasons = " ".join(example.why for example in evaluation.examples)
    assert "most motion" in reasons
    assert "best" in reasons
    for example in evaluation.examples:
        assert example.frames is not None
        assert example.frames.shape == (TIME, 8, 8, 3)
        assert list(example.errors) == ["persistence", "base", "adapter"]
        np.testing.assert_allclose(example.errors["base"], example.errors["persistence"])
        np.testing.assert_allclose(example.errors["adapter"], example.errors["base"] / 2, rtol=1e-3)


def test_vector_actions_have_no_unit_and_vectors_of_two_numbers_no_landscape() -> None:
    evaluated_models = [EvaluatedModel("model", "trained", Oracle())]
    vectors, narrow = (
        evaluate(
            evaluated_models,
            repeatable_clips(clips_batch(width=width), space=make_vector_actions(width, "change")),
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
    active: list[str] = []

    @contextmanager
    def base_context() -> Iterator[None]:
        active.append("base")
        yield
        active.pop()

    class InContext(Copier):
        def predict(self, *inputs, **options):  # type: ignore[no-untyped-def]
            assert active == ["base"]
            return super().predict(*inputs, **options)

    class OutsideContext(Oracle):
        def predict(self, *inputs, **options):  # type: ignore[no-untyped-def]
            assert not active
            return super().predict(*inputs, **options)

    evaluated_models = [
        EvaluatedModel("base", "base", InContext(), base_context),
        EvaluatedModel("adapter", "trained", OutsideContext()),
    ]
    evaluate(evaluated_models, repeatable_clips(clips_batch()), about(), probes=PROBES)


# ---- which steps move ----


def described(*actions: list[float], space: ActionSpace = POSE_CHANGE) -> Clips:
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
def test_step_counts_as_moving_if_the_flange_translates_or_rotates_or_the_gripper_moves(
    action: list[float], moves: bool
) -> None:
    clips = described(action)
    assert clips.moving.tolist() == [[moves]]
    assert clips.action_size[0, 0] == pytest.approx(np.linalg.norm(action[:3]) * 100)


def test_moving_steps_of_vectors_are_relative_to_the_95th_percentile() -> None:
    clips = described([1.0, 0.0], [0.05, 0.0], [0.0, 0.2], [0.0, 0.0], space=make_vector_actions(2, "change"))
    assert clips.moving.tolist() == [[True, False, True, False]]
    assert not described([0.0, 0.0], space=make_vector_actions(2, "change")).moving.any()


# ---- errors, and actions of other clips ----


def test_metrics_equal_a_case_computed_by_hand() -> None:
    predicted = torch.tensor([[[[1.0, 0.0], [0.0, 2.0]]]])
    true = torch.tensor([[[[0.0, 1.0], [0.0, 1.0]]]])
    assert L1.of(predicted, true).tolist() == [[(1 + 1 + 0 + 1) / 4]]
    assert L2.of(predicted, true).tolist() == [[(1 + 1 + 0 + 1) / 4]]
    assert L2.of(predicted * 3, predicted).tolist() == [[(4 + 16) / 4]], "mean square, without the root"


def test_errors_by_horizon_equal_a_case_computed_by_hand() -> None:
    latents = torch.zeros(1, 3, 2, 2)
    latents[0, 1] = 1.0
    latents[0, 2] = torch.tensor([[3.0, 3.0], [5.0, 5.0]])
    batch = LatentBatch(latents, torch.zeros(1, 3, 7), torch.zeros(1, 2, 7), None, ("e",), (0,))
    errors = measure_errors(Copier(), batch, VALIDATION_PREDICTIONS, (L1, L2), batch.actions)
    assert errors.of("rollout").tolist() == [[1.0, 4.0]], "copies of the first frame"
    assert errors.of("teacher_forced").tolist() == [[1.0, 3.0]], "copies of the previous frame"
    assert errors.of("rollout", L2).tolist() == [[1.0, 17.0]]
    for (actions, mode, metric), values in errors.arrays.items():
        assert values.tolist() == errors.arrays["true", mode, metric].tolist(), actions
    assert errors.episode_ids == ("e",)


def test_a_validation_has_the_errors_of_an_evaluation_of_the_same_clips() -> None:
    errors = prediction_errors(Halfway(), in_batches(clips_batch(), 4))
    assert errors.arrays.keys() == {(actions, mode, "l1") for actions, mode in VALIDATION_PREDICTIONS}
    probes = ProbeOptions(ranking_clips=0, landscape_clips=0, examples=0)
    evaluation = evaluate(
        [EvaluatedModel("model", "trained", Halfway())], repeatable_clips(clips_batch()), about(), probes=probes
    )
    evaluated_errors = evaluation.models["model"].errors
    assert evaluated_errors.episode_ids == errors.episode_ids
    for kind, values in errors.arrays.items():
        np.testing.assert_array_equal(values, evaluated_errors.arrays[kind])
    with_l2 = prediction_errors(Halfway(), in_batches(clips_batch(), 4), (L1, L2))
    assert {metric for _, _, metric in with_l2.arrays} == {"l1", "l2"}


@pytest.mark.parametrize("size", [1, 3, 12])
def test_shuffled_actions_are_those_of_the_previous_clip_for_any_batch_size(size: int) -> None:
    batch = clips_batch()
    shuffled = torch.cat([actions for _, actions in with_shuffled_actions(in_batches(batch, size))])
    assert torch.equal(shuffled, batch.actions[[1, *range(11)]]), "the first clip gets the actions of the second"


@pytest.mark.parametrize("processes", [2, 3, 4])
def test_shuffled_actions_do_not_depend_on_number_of_processes(processes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = clips_batch()
    for is_readable in product([True, False], repeat=7):
        readable = [clip for clip in range(7) if is_readable[clip]]

        def read(windows, readable=readable):  # type: ignore[no-untyped-def]
            return (rows(batch, [clip]) for clip in windows if clip in readable)

        shuffled = [torch.zeros(0, *batch.actions.shape[1:])]
        for process in range(processes):
            accelerator = SimpleNamespace(process_index=process, num_processes=processes)
            monkeypatch.setattr(distributed, "_sharing", accelerator)
            own_clips = own_share(7, 2)
            before = previous_clip_actions(own_clips, range(7), read)
            shuffled += [actions for _, actions in with_shuffled_actions(read(own_clips), before)]
        actions = rows(batch, readable).actions
        expected = actions.flip(1) if len(actions) == 1 else torch.cat([actions[1:2], actions[:-1]])
        assert torch.equal(torch.cat(shuffled), expected), is_readable


def test_single_clip_gets_its_reversed_actions() -> None:
    batch = rows(clips_batch(), [0])
    [(_, shuffled)] = list(with_shuffled_actions([batch]))
    assert torch.equal(shuffled, batch.actions.flip(1))
