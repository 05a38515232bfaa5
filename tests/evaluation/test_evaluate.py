"""An oracle has error 0, a copier equals persistence and ignores its actions, reproducibly."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from torch import Tensor

from vjepa2_ac.evaluation.estimates import (
    difference_to,
    gain_over,
    gap_of_actions,
    mean_error,
    one_step_over_persistence,
    over_persistence,
    stratum_gain,
)
from vjepa2_ac.evaluation.evaluate import Contender, evaluate
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import L1, L2, MODES, Evaluation, PredictionErrors, Stratum
from vjepa2_ac.evaluation.rows import rows_of
from vjepa2_ac.evaluation.summary import summarize
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.planning.axes import Axes
from vjepa2_ac.reports.metrics_json import metrics_as_dict
from vjepa2_ac.spaces import vector_actions
from worlds import DIM, TIME, TOKENS, Copier, Halfway, Oracle, about, again, clips_batch

PROBES = ProbeOptions(ranking_clips=6, samples=20, landscape_clips=3, axis_clips=0, nodes=5, examples=3, at_once=7)


def evaluated(trained: object, base: object | None = None, *, size: int = 4, **changes: object) -> Evaluation:
    contenders = [] if base is None else [Contender("base", "base", base)]  # type: ignore[arg-type]
    contenders.append(Contender("adapter", "trained", trained))  # type: ignore[arg-type]
    batch = clips_batch(actions=changes.pop("actions", None))  # type: ignore[arg-type]
    probes = replace(PROBES, axis_clips=changes.pop("axis_clips", 0))  # type: ignore[arg-type]
    return evaluate(contenders, again(batch, size), about(**changes), probes=probes)


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
    found = summarize(oracle, rows_of(oracle))
    assert found.predicts.statement.startswith("error 100 % lower than with the base model")
    assert found.uses_actions.conclusion == "yes"


def test_spread_and_discrepancy_of_the_rollouts_are_those_of_the_predicted_latents() -> None:
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
    assert len(found.noise_floor) == TIME - 1


def test_a_model_that_ignores_actions_has_the_action_ranking_error_of_chance() -> None:
    found = evaluated(Copier())
    ranking = found.models["adapter"].ranking
    assert ranking is not None
    assert ranking.change == Estimate(0.0, 0.0, 0.0)
    assert set(ranking.ranks) == {0.5}
    assert gap_of_actions(found.models["adapter"].errors, "shuffled") == Estimate(0.0, 0.0, 0.0)
    assert summarize(found, rows_of(found)).uses_actions.conclusion == "no"


def test_the_prediction_of_an_oracle_changes_with_the_action(oracle: Evaluation) -> None:
    ranking = oracle.models["adapter"].ranking
    assert ranking is not None
    assert ranking.change.value > 0.5


def test_a_difference_is_what_is_computed_by_hand() -> None:
    found = evaluated(Halfway(), Copier())
    errors, base = pair_of(found)
    assert [one.value for one in over_persistence(errors, "teacher_forced")] == pytest.approx([0.5] * 4)
    assert [one.value for one in over_persistence(errors, "rollout", L2)] == pytest.approx([0.25] * 4)
    gains = gain_over(errors, base)
    assert [(one.low, one.value, one.high) for one in gains] == [pytest.approx((0.5, 0.5, 0.5))] * 4
    differences = difference_to(errors, base, "teacher_forced")
    nothing = mean_error(errors, "teacher_forced", way="persistence")
    assert [one.value for one in differences] == pytest.approx([-one.value / 2 for one in nothing])


def test_wrong_actions_give_the_errors_that_they_give(oracle: Evaluation) -> None:
    errors = oracle.models["adapter"].errors
    zero = over_persistence(errors, "teacher_forced", way="zero")
    assert [one.value for one in zero] == pytest.approx([1.0] * (TIME - 1), rel=1e-5), "nothing done, nothing moves"
    batch = clips_batch()
    others = batch.actions[[1, *range(11)]]
    expected = (others - batch.actions)[..., :DIM].abs().mean(dim=(0, 2)) * 100
    shuffled = mean_error(errors, "teacher_forced", way="shuffled")
    assert [one.value for one in shuffled] == pytest.approx(expected.tolist(), rel=1e-4)


def test_a_part_counts_its_own_steps_only(oracle: Evaluation) -> None:
    first = np.zeros((12, TIME - 1), bool)
    first[:, 0] = True
    errors, base = pair_of(oracle)
    nothing = errors.of("teacher_forced", way="persistence")
    made_up = np.where(first, 2 * nothing, nothing / 4)
    errors = replace(errors, arrays={**errors.arrays, ("true", "teacher_forced", "l1"): made_up})
    for part, value in ((Stratum("motion.first", "first", first), 2.0), (Stratum("motion.rest", "rest", ~first), 0.25)):
        assert one_step_over_persistence(errors, "true", part).value == pytest.approx(value)
        assert stratum_gain(errors, base, part).value == pytest.approx(1 - value)


def test_the_same_evaluation_twice_gives_the_same_file_and_another_seed_other_actions(oracle: Evaluation) -> None:
    assert metrics_as_dict(evaluated(Oracle(), Copier())) == metrics_as_dict(oracle)
    first, second = (found.models["adapter"].ranking for found in (oracle, evaluated(Oracle(), seed=1)))
    assert first is not None
    assert second is not None
    assert first.change != second.change


def test_episodes_are_ranked_by_how_well_they_are_predicted() -> None:
    found = evaluated(Halfway(), Copier())
    assert [score.clips for score in found.episodes] == [2] * 6
    ratios = [score.over_persistence for score in found.episodes]
    assert ratios == sorted(ratios)
    assert all(score.gain_over_base == pytest.approx(0.5) for score in found.episodes)
    assert evaluated(Halfway()).episodes[0].gain_over_base is None


def test_examples_are_the_best_the_worst_and_the_liveliest_with_their_errors(oracle: Evaluation) -> None:
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
        assert example.true_colours.shape == (TIME, 2, 2, 3)
        assert example.predicted_colours["adapter"].shape == (TIME - 1, 2, 2, 3)
    shown = oracle.examples[0]
    np.testing.assert_array_equal(shown.predicted_colours["adapter"], shown.true_colours[1:])
    assert not np.array_equal(shown.predicted_colours["base"], shown.true_colours[1:])


def test_vectors_have_no_centimetres_and_too_few_numbers_no_landscape() -> None:
    contenders = [Contender("model", "trained", Oracle())]
    vectors = evaluate(contenders, again(clips_batch(width=4)), about(space=vector_actions(4, "change")), probes=PROBES)
    landscapes = vectors.models["model"].landscapes
    assert landscapes is not None
    assert (landscapes.unit, landscapes.axis_names[0]) == ("", "action 0")
    narrow = evaluate(contenders, again(clips_batch(width=2)), about(space=vector_actions(2, "change")), probes=PROBES)
    assert narrow.models["model"].landscapes is None
    assert "an action has 2 numbers" in narrow.notes[0]
    json.dumps(metrics_as_dict(narrow), allow_nan=False)


def test_each_model_is_measured_only_while_it_is_switched_on() -> None:
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

    contenders = [Contender("base", "base", Watched(), switch), Contender("adapter", "trained", Unwatched())]
    evaluate(contenders, again(clips_batch()), about(), probes=PROBES)


def test_the_axes_of_base_and_adapter_are_found_and_those_of_vectors_are_not() -> None:
    class Quarter(Oracle):
        """Takes what goes along x for a move along y."""

        def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
            return super().predict(latents, Axes(-np.pi / 2).actions(actions), states, extrinsics)

    found = evaluated(Oracle(), Quarter(), axis_clips=6)
    yaws = {row.model: row.value for row in rows_of(found) if row.key == "axes.yaw_degrees"}
    assert yaws == {"base": pytest.approx(90.0, abs=3.0), "adapter": pytest.approx(0.0, abs=3.0)}
    written = metrics_as_dict(found)["models"]
    assert {name: one["axes"]["yaw_degrees"]["value"] for name, one in written.items()} == yaws
    vectors = evaluated(Oracle(), space=vector_actions(7, "change"), axis_clips=6)
    assert not vectors.models["adapter"].beside


def test_nothing_but_errors_is_measured_where_nothing_else_is_asked_for() -> None:
    probes = ProbeOptions(ranking_clips=0, landscape_clips=0, examples=0)
    found = evaluate([Contender("model", "trained", Oracle())], again(clips_batch()), about(), probes=probes)
    assert found.notes == ()
    assert found.models["model"].ranking is None
    assert found.models["model"].landscapes is None
    assert found.examples == ()
    assert one_step_over_persistence(found.models["model"].errors).value == pytest.approx(0.0, abs=1e-5)
    assert (TOKENS, DIM) == (4, 6)
