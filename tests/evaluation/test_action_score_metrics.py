"""Scores, errors, angles and signs equal those computed by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evaluation_results import evaluation
from planned import study, with_plans
from vjepa2_ac.evaluation.action_score import differences_of, metrics_of, missed_cm
from vjepa2_ac.evaluation.result import Evaluation, Plans
from vjepa2_ac.evaluation.rows import rows_of
from vjepa2_ac.reports.comparison import compare
from vjepa2_ac.reports.metrics_json import write_metrics


def actions(*rows: tuple[float, ...]) -> np.ndarray:
    """Return actions of which the first numbers are given, in cm."""
    return np.array([[*(value / 100 for value in row), *[0.0] * (7 - len(row))] for row in rows])


DEMONSTRATED = np.stack([
    actions((3, 0, 0), (3, 1, 0), (0, 1, -1)),  # (6, 2, -1)
    actions((0, 4, 0), (0, 0, 0), (2, 0, 0)),  # (2, 4, 0)
])  # fmt: skip
PLANNED = np.stack([
    actions((0, 3, 0), (9, 0, 0), (0, 1, 1)),  # (9, 4, 1): off by 3, 2, 2
    actions((0, -2, 0), (1, 1, 0), (2, 0, 0)),  # (3, -1, 0): off by 1, 5, 0
])  # fmt: skip


def test_the_score_is_made_of_the_ends_of_the_plans_along_each_axis() -> None:
    made_up = study(DEMONSTRATED)
    plans = Plans(PLANNED[None, :, 0], PLANNED[None])
    np.testing.assert_allclose(missed_cm(made_up, plans), [7.0, 6.0])
    found = metrics_of(made_up, plans)
    assert found["missed_cm"].value == pytest.approx(6.5)
    assert found["score"].value == pytest.approx(800 * (0.1 - 0.065))
    assert found["missed_over_zero"].value == pytest.approx(13 / (9 + 6))
    halves = differences_of(made_up, plans, made_up.zero)
    assert halves["missed_cm"].value == pytest.approx(6.5 - 7.5)
    assert halves["score"].value == pytest.approx(28 - 20)
    assert halves["step_cm"].value == pytest.approx((18**0.5 + 6) / 2 - 3.5)


def test_a_score_is_not_below_zero_and_detours_do_not_count() -> None:
    far = PLANNED.copy()
    far[..., 2] += 0.1
    assert metrics_of(study(DEMONSTRATED), Plans(far[None, :, 0], far[None]))["score"].value == 0.0
    backwards = DEMONSTRATED[:, ::-1]
    assert metrics_of(study(DEMONSTRATED), Plans(backwards[None, :, 0], backwards[None]))["score"].value == 80.0


def test_one_step_has_errors_along_axes_an_angle_and_signs() -> None:
    found = metrics_of(study(DEMONSTRATED), Plans(PLANNED[None, :, 0], PLANNED[None]))
    assert found["step_cm"].value == pytest.approx((18**0.5 + 6) / 2)
    assert found["step_over_zero"].value == pytest.approx((18**0.5 + 6) / 7)
    assert [found[f"axes_cm.{axis}"].value for axis in "xyz"] == pytest.approx([1.5, 4.5, 0.0])
    assert found["angle_degrees"].value == pytest.approx((90 + 180) / 2)
    assert found["signs.x"].value == 0.5, "x of the first: nothing was planned"
    assert found["signs.y"].value == 0.0, "y of the second: backwards"
    assert np.isnan(found["signs.z"].value), "nobody moves along z"


def test_steps_too_short_to_have_a_direction_are_left_out() -> None:
    demonstrated = np.stack([actions((0.4, 0, 0), (0,), (0,)), actions((0.3, 0.6, 0), (0,), (0,))])
    planned = np.stack([actions((-1, 0, 0), (0,), (0,)), actions((-1, 2, 0), (0,), (0,))])
    found = metrics_of(study(demonstrated), Plans(planned[None, :, 0], planned[None]))
    between = np.degrees(np.arccos((-0.3 + 1.2) / (0.45**0.5 * 5**0.5)))
    assert found["angle_degrees"].value == pytest.approx(between)
    assert np.isnan(found["signs.x"].value)
    assert found["signs.y"].value == 1.0


def test_doing_nothing_has_the_angle_and_the_signs_of_chance() -> None:
    made_up = study(DEMONSTRATED)
    found = metrics_of(made_up, made_up.zero)
    assert found["angle_degrees"].value == 90.0
    assert [found[f"signs.{axis}"].value for axis in "xy"] == [0.5, 0.5]
    assert found["step_over_zero"].value == 1.0
    assert found["missed_over_zero"].value == 1.0


def test_the_gripper_is_off_by_its_change_of_closedness() -> None:
    demonstrated, planned = DEMONSTRATED.copy(), PLANNED.copy()
    demonstrated[0, 0, 6], planned[1, 0, 6] = 0.5, -0.2
    found = metrics_of(study(demonstrated), Plans(planned[None, :, 0], planned[None]))
    assert found["gripper"].value == pytest.approx(0.35)


def test_several_draws_of_a_plan_count_with_their_mean_error() -> None:
    made_up = study(DEMONSTRATED)
    both = Plans(np.stack([PLANNED, DEMONSTRATED])[:, :, 0], np.stack([PLANNED, DEMONSTRATED]))
    np.testing.assert_allclose(missed_cm(made_up, both), [3.5, 3.0])
    assert metrics_of(made_up, both)["step_cm"].value == pytest.approx((18**0.5 + 6) / 4)


@pytest.fixture
def found() -> Evaluation:
    return with_plans(evaluation())


def test_rows_show_models_beside_what_takes_none_and_the_difference_to_the_base(found: Evaluation) -> None:
    rows = {(row.key, row.model): row.value for row in rows_of(found)}
    models = [model for key, model in rows if key == "plans.score"]
    assert models == ["zero action", "random", "within limits", "base", "adapter"]
    assert rows["plans.score", "within limits"] == 80.0
    for name in ("missed_cm", "step_cm"):
        difference = rows[f"plans.{name}", "adapter"] - rows[f"plans.{name}", "base"]
        assert rows[f"plans_minus_base.{name}", "adapter"] == pytest.approx(difference)
        assert (f"plans_minus_base.{name}", "base") not in rows


def test_compare_shows_the_score_where_there_is_one(found: Evaluation, tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("with", "other", "without", "neither")]
    others = replace(found, planning=replace(found.planning, places=(1,) * 8))  # type: ignore[type-var]
    for folder, one in zip(folders, (found, others, evaluation(), evaluation()), strict=True):
        folder.mkdir()
        write_metrics(one, folder / "metrics.json")
    compared = compare([folders[0], folders[2]])
    scores = {row.model: row.value for row in compared.rows if row.key == "plans.score"}
    assert scores == {
        "with": next(row.value for row in rows_of(found) if (row.key, row.model) == ("plans.score", "adapter"))
    }
    assert not compared.notes
    assert any("other frames" in note for note in compare(folders[:2]).notes)
