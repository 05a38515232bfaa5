"""The predecessor study: its mistakes cause warnings, its page shows the stored results, and its cells are measured."""

import json
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from paths import ROOT
from synthetic import write_synthetic_droid
from vjepa2_ac.evaluation.result import PredictionErrors
from vjepa2_ac.intervals import estimate_mean
from vjepa2_ac.training.config_warnings import list_config_warnings


@pytest.fixture(scope="module")
def study() -> Iterator[Any]:
    """The module `predecessor`, with the modules `tables` and `results` as attributes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "evidence"))
        study = import_module("predecessor")
        patch.setattr(study, "tables", import_module("predecessor_tables"), raising=False)
        patch.setattr(study, "results", import_module("results"), raising=False)
        yield study
    for path in (ROOT / "evidence").glob("[!_]*.py"):
        sys.modules.pop(path.stem, None)


@pytest.mark.parametrize(
    ("condition", "topics"),
    [
        ("all mistakes", ["camera", "model step", "warm-up", "no validation"]),
        ("short schedule", ["warm-up"]),
        ("wrist camera", ["camera"]),
        ("other model step", ["model step"]),
        ("done right", []),
    ],
)
def test_each_mistake_of_the_predecessor_causes_its_warning(
    study: Any, condition: str, topics: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study, "exclude_episodes", lambda *_: ())
    config = study.make_config(study.Cell(condition, 0), tmp_path)
    warnings = list_config_warnings(config, float(study.CONTROL_RATE_HZ))
    assert [study.tables.describe_topic(warning) for warning in warnings] == topics
    by_init = study.list_init_warnings(study.CONDITIONS[condition])
    assert [study.tables.describe_topic(warning) for warning in by_init] == topics[:1] * ("camera" in topics)


def test_validations_are_compared_with_the_base_model_and_selected_as_by_keep_best(study: Any) -> None:
    episodes = tuple(f"episode {index}" for index in range(10))

    def validation(ranks: np.ndarray, error: float) -> SimpleNamespace:
        arrays = {("true", "rollout", "l1"): np.full((10, 1), error)}
        arrays["persistence", "rollout", "l1"] = np.ones((10, 1))
        ranking = SimpleNamespace(ranks=ranks, episode_ids=episodes, rank=estimate_mean(ranks, episodes))
        return SimpleNamespace(errors=PredictionErrors(episodes, arrays), ranking=ranking)

    base = np.linspace(0.3, 0.5, 10)
    at_chance = base + np.tile([0.3, -0.34], 5)  # 2 points better on average; the interval contains 50 %
    measured = {0: validation(base, 1.0), 20: validation(at_chance, 0.9), 40: validation(base - 0.01, 0.8)}
    rows = study.compare_validations(measured)["validations"]
    assert [row["rollout_error"] for row in rows] == [1.0, 0.9, 0.8]
    assert rows[2]["difference"] == pytest.approx([-0.01] * 3)
    assert study.tables.select_step(rows) == 40
    assert study.tables.select_step(rows, is_former_rule=True) == 20
    assert study.tables.select_step(rows[:2]) == 0
    worse = study.compare_validations({0: validation(base, 1.0), 20: validation(base + 0.1, 0.1)})["validations"]
    assert study.tables.select_step(worse) == 0


def test_tables_of_the_predecessor_page_equal_the_stored_results(study: Any) -> None:
    tables = study.tables
    stored = tables.group_results(json.loads((study.results.RESULTS / "predecessor.json").read_text()))
    page = (ROOT / "docs/predecessor.md").read_text()
    for table in (tables.figures_table, tables.conditions_table, tables.selection_table, tables.warnings_table):
        assert table(stored) in page, table.__name__
    text = (study.results.RESULTS / "predecessor.md").read_text()
    assert tables.checkpoints_table(stored) in text
    assert tables.measurements_table(stored) in text


@pytest.fixture(scope="module")
def small_folder(study: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A work folder with synthetic episodes, and the smallest settings."""
    folder = tmp_path_factory.mktemp("predecessor")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"STEPS": 4, "DEMONSTRATIONS": 4, "CLIPS": 6, "PAIRS": 2, "NODES": 3, "SAMPLES": 2}.items():
            patch.setattr(study, name, value)
        patch.setattr(study, "PLANNING", study.PLANNING.model_copy(update={"samples": 12, "iterations": 1}))
        mistakes = study.Condition(study.WRIST, study.OTHER_STRIDE, steps=2, is_validated=False)
        patch.setattr(study, "ALL", {**study.ALL, "all mistakes": mistakes, "done right": study.Condition(steps=4)})
        patch.setattr(study, "WARMUP", 1)
        patch.setattr(study, "SHORT", 2)
        write_synthetic_droid(folder / "data-predecessor", episodes=16, steps=41, size=(36, 64))
        study.prepare_views(folder)
        yield folder


@pytest.mark.parametrize(
    ("condition", "views"),
    [
        ("base model, exterior, stride 4", ["own"]),
        ("done right", ["own"]),
        ("all mistakes", ["own", "base's"]),
    ],
)
def test_condition_of_the_study_is_trained_and_measured(
    study: Any, small_folder: Path, condition: str, views: list[str]
) -> None:
    cell = study.Cell(condition, 0)
    result = {"cell": vars(cell)} | json.loads(json.dumps(study.measure(cell, small_folder, 1)))
    assert list(result["measured"]) == views
    for measured in result["measured"].values():
        value, low, high = measured["offset_cm"]
        assert 0 <= low <= value <= high <= 26 + 15  # the diagonal of the grid, which is shifted by the true action
        assert 0 <= measured["rank"][0] <= 1
        assert measured["sharpness"][0] > 0
    assert len(result["ends_cm"]) == 1
    if condition == "all mistakes":
        assert [row["step"] for row in result["validations"]] == [0, 2]
        topics = {study.tables.describe_topic(warning) for warning in result["check"]}
        assert {"camera", "model step", "warm-up", "no validation"} <= topics
        assert result["train"][: len(result["check"])] == result["check"]
    grouped = study.tables.group_results([result])
    assert study.tables.measurements_table(grouped).count("\n") == 1 + len(views)
    assert study.tables.conditions_table(grouped).count("not measured") > 0
