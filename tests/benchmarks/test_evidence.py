"""The evidence: its page shows the stored results, and each kind of cell can be measured."""

import json
import sys
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from paths import ROOT
from vjepa2_ac.config import ValidationConfig
from vjepa2_ac.policies.action_prior import PriorOptions, train_prior
from vjepa2_ac.simulation.record import RecordingSpec

MODULES = (
    "environments", "methods", "prepare", "offline", "results", "measure", "tables", "selection",
    "selection_tables",
)  # fmt: skip


@pytest.fixture(scope="module")
def evidence() -> Iterator[Any]:
    """The modules of `evidence`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "evidence"))
        yield SimpleNamespace(**{name: import_module(name) for name in MODULES})
    for name in MODULES:
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def stored(evidence: Any) -> list[dict[str, Any]]:
    """The results of the methods study in the repository."""
    return json.loads((evidence.results.KEPT / "methods.json").read_text())


def test_condition_names_are_unique_and_each_stored_result_has_a_condition(evidence: Any, stored: Any) -> None:
    cells = list(evidence.methods.all_cells(at_most=5))
    assert len({cell.name for cell in cells}) == len(set(cells)) == len(cells)
    assert not any("/" in cell.name for cell in cells), "names of files"
    names = {evidence.results.name_of(one) for one in stored}
    assert len(names) == len(stored)
    assert {cell.name for cell in cells} <= names, "every cell is measured"
    checkpoints = list(evidence.selection.all_cells(seeds=3))
    selection = json.loads((evidence.results.KEPT / "selection.json").read_text())
    assert {cell.name for cell in checkpoints} <= {evidence.selection.name_of(one) for one in selection}


def test_tables_of_the_page_equal_the_stored_results(evidence: Any, stored: Any) -> None:
    page = (ROOT / "docs/evidence.md").read_text()
    assert evidence.tables.summary(stored) in page
    assert evidence.tables.summary_of_tasks(stored) in page
    assert evidence.tables.summary_of_correlations(evidence.tables.correlated_numbers(stored)) in page
    text = (evidence.results.KEPT / "methods.md").read_text()
    assert "\n\n".join(evidence.tables._rows(stored)) in text
    assert evidence.tables.goal_by_goal(stored) in text
    selection = json.loads((evidence.results.KEPT / "selection.json").read_text())
    rules = "\n".join(evidence.selection_tables._rules(evidence.selection_tables.by_run(selection)))
    assert rules in (evidence.results.KEPT / "selection.md").read_text()
    assert sum(path.stat().st_size for path in evidence.results.KEPT.glob("*.json")) < 300_000


@pytest.fixture(scope="module")
def small(evidence: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Everything at its smallest: two steps, one goal; the numbers mean nothing."""
    methods, prepare, measure = evidence.methods, evidence.prepare, evidence.measure
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(methods, "STEPS", 2)
        patch.setattr(methods, "TRAINING", methods.TRAINING.model_copy(update={"warmup_steps": 1, "batch_size": 2}))
        patch.setattr(measure, "ValidationConfig", lambda clips, **given: ValidationConfig(clips=clips // 10, **given))
        few = methods.PLANNING.model_copy(update={"samples": 12, "iterations": 1})
        patch.setattr(measure, "PLANNING", few)
        patch.setattr(measure, "CLIPS", 6)
        patch.setattr(evidence.offline, "MOVES", 2)
        patch.setattr(measure, "train_prior", partial(train_prior, options=PriorOptions(steps=2)))
        patch.setattr(measure, "base_model", lambda *_: prepare.BUILTIN)
        patch.setattr(prepare, "RecordingSpec", partial(RecordingSpec, steps=14))
        evidence.folder = tmp_path_factory.mktemp("evidence")
        make = prepare.data_shifted
        held_out = {"validation_share": 0.2, "test_share": 0.3}
        for module in (prepare, measure):
            patch.setattr(module, "data_shifted", lambda *given: make(*given).model_copy(update=held_out))
        data = prepare.data_shifted(evidence.folder, "look")
        prepare._record(data, "look", 11, 3)
        prepare.keep_latents(data, prepare.BUILTIN)
        yield evidence


@pytest.mark.parametrize("method", ["LoRA r4 + in/out", "zero-shot", "behaviour cloning"])
def test_experimental_condition_is_trained_and_measured(small: Any, method: str) -> None:
    base = "none" if method == "behaviour cloning" else "many cameras"
    cell = small.methods.Cell("look", base, method, 0 if method == "zero-shot" else 4, 0)
    figures = json.loads(json.dumps(small.measure.measure(cell, small.folder, 1)))
    assert len(figures["reach"]["l1"]["distance_cm"][0]) == 9
    assert ("offline" in figures) == ("shifted" in figures) == (method != "behaviour cloning")
    assert set(figures["made_with"]) == {"torch", "commit"}
    assert (figures["trained_share"] == 0) == (method == "zero-shot")
    compact = small.results.compact(figures)
    row = small.tables._row(method, "20", [compact])
    assert row.count("|") == small.tables.HEAD.count("|") + 2
    if method == "zero-shot":
        ends = {name: one["ends_cm"][0] for name, one in compact["baselines"].items()}
        assert ends["oracle"] < 1 < ends["zero action"]


def test_runs_of_the_selection_study_differ_and_the_plots_are_drawn(evidence: Any, stored: Any, tmp_path: Path) -> None:
    runs = {cell.run for cell in evidence.selection.all_cells(seeds=1)}
    assert len(runs) == 7
    for run in runs:
        assert (evidence.selection.config_of(run, tmp_path).replay is not None) == (run.cure == "replay")
    evidence.tables.draw(stored, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
