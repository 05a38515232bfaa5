"""The report compares a model's plans with model-free ones, or explains why there are none."""

import re
from dataclasses import replace

import pytest

from evaluation_results import evaluation
from planned import with_plans
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.evaluation.action_score.metrics import metrics_of, missed_cm
from vjepa2_ac.evaluation.result import Evaluation
from vjepa2_ac.reports.html.formatting import decimal
from vjepa2_ac.reports.html.page import report_page
from vjepa2_ac.reports.html.planning import planning_section


@pytest.fixture(scope="module")
def found() -> Evaluation:
    return with_plans(evaluation())


@pytest.fixture(scope="module")
def page(found: Evaluation) -> str:
    return planning_section(found)


def row(page: str, name: str) -> list[str]:
    """Return the cells of the first row with that name."""
    cells = re.search(rf'<th scope="row">{re.escape(name)}</th>(.*?)</tr>', page)
    assert cells is not None, name
    return [re.sub("<[^>]+>", "", cell) for cell in re.findall("<td>(.*?)</td>", cells[1])]


def test_every_way_of_planning_has_its_score_beside_those_that_take_no_model(found: Evaluation, page: str) -> None:
    study = found.planning
    assert study is not None
    for name, model in found.models.items():
        assert model.plans is not None
        score, missed, over, beside = row(page, name)
        metrics = metrics_of(study, model.plans)
        assert score.startswith(decimal(metrics.score.value, 1))
        assert missed.startswith(decimal(missed_cm(study, model.plans).mean(), 1))
        assert over.startswith(decimal(metrics.missed_over_zero.value, 2))
        assert bool(beside) == (name != "base")
    assert row(page, "demonstration within limits")[0].startswith("80.0")
    assert row(page, "doing nothing")[2].startswith("1.00")
    assert row(page, "random")[3] == ""


def test_the_charts_put_each_plan_where_it_ends(found: Evaluation, page: str) -> None:
    charts = re.findall("<svg.*?</svg>", page, re.DOTALL)
    assert sum("planned along" in chart for chart in charts) == 3
    assert [chart.count('class="mark s-trained"') for chart in charts[:3]] == [8, 8, 8]
    study, plans = found.planning, found.models["adapter"].plans
    assert study is not None
    assert plans is not None
    for axis, chart in enumerate(charts[:3]):
        demonstrated, planned = (
            100 * float(steps[0, :, axis].sum()) for steps in (study.demonstrated, plans.three_steps[0])
        )
        assert f"adapter: {decimal(planned, 3)} at {decimal(demonstrated, 2)}" in chart


def test_steps_of_limits_and_settings_are_named(found: Evaluation) -> None:
    study = found.planning
    assert study is not None
    limits = LimitsConfig(xyz=(0.05, 0.02, 0.01))
    settings = PlanningConfig(planner="gradient", iterations=33, limits=limits)
    other = replace(found, planning=replace(study, settings=settings, one_step_beyond=0.25, three_steps_beyond=0.5))
    words = planning_section(other)
    assert "gradient, 8 starts, 33 iterations, L1 energy, at most 5, 2, 1 cm" in words
    assert re.search(r"25\W% of the demonstrated steps", words)
    assert re.search(r"Of the demonstrated steps 50\W% go", words)


def test_without_a_base_nothing_is_compared_with_it() -> None:
    words = planning_section(with_plans(evaluation(with_base=False)))
    assert "difference to the base" not in words


def test_a_report_without_plans_says_how_to_get_them_or_why_there_are_none() -> None:
    assert "evaluate --planning" in planning_section(evaluation())
    vectors = replace(evaluation(), notes=("No plans: the states here are plain numbers.",))
    assert "plain numbers" in planning_section(vectors)
    assert 'id="planning"' in report_page(evaluation(), "")
