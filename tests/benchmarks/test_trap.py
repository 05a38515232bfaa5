"""The trap runs what can be run, and its tables keep what was measured of a cure that is gone."""

import json
import shutil
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from paths import ROOT

pytest.importorskip("mujoco")


@pytest.fixture
def trap(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The modules of benchmarks/trap."""
    names = ("runs", "tables")
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks/trap"))
    yield SimpleNamespace(**{name: import_module(name) for name in names})
    for name in names:
        sys.modules.pop(name)


def test_every_run_has_a_name_and_a_config_of_its_own_and_only_replay_is_left_as_a_cure(
    trap: Any, tmp_path: Path
) -> None:
    runs = list(trap.runs.all_runs(seeds=3))
    assert len({run.name for run in runs}) == len(runs) == 12 + 9
    assert {run.cure for run in runs} == {"", "replay"}
    for run in runs:
        assert (trap.runs.config_of(run, tmp_path).replay is not None) == (run.cure == "replay")


def test_what_was_measured_of_a_cure_that_is_gone_stays_in_the_tables_with_a_note(
    trap: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trap.tables, "_correlations", lambda _: iter(()))  # which draws for a minute
    shutil.copy(ROOT / "benchmarks/results/trap.json", tmp_path)
    trap.tables.write_tables(tmp_path, None)
    text = (tmp_path / "trap.md").read_text()
    assert "| narrow | LoRA | contrast | last | 800" in text
    assert "measured at commit 6117de8, the last with the term" in text
    cells = {name: one for name, one in trap.tables.read_cells(tmp_path).items() if "contrast" not in name}
    (tmp_path / "trap.json").write_text(json.dumps(cells))
    trap.tables.write_tables(tmp_path, None)
    assert "contrast" not in (tmp_path / "trap.md").read_text()


def test_errors_of_the_evidence_are_compared_with_the_distance_at_the_end_and_worlds_are_not_mixed(
    trap: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spearman = trap.tables._spearman
    monkeypatch.setattr(trap.tables, "_with_interval", lambda pairs, _: f"{spearman(np.concatenate(pairs)):+.2f}")

    def cell(shift: str, error: float, way_cm: list[float], **reach: object) -> dict[str, object]:
        about = {"shift": shift, "base": "none"}
        l1 = {"distance_cm": [way_cm], **reach}
        return {"cell": about, "shifted": {"rollout_over_persistence": [error]}, "reach": {"l1": l1}}

    cells = [cell("look", error, [30.0 - 3 * error, error]) for error in range(1, 10)]  # the mean falls with the error
    cells += [cell("Lift", error, [0.0, -error], solved=[True]) for error in range(1, 10)]
    cells += [cell("motion", 1.0, [0.0, 1.0])] * 2
    (tmp_path / "evidence.json").write_text(json.dumps(cells))
    rows = [line.strip("| ").split(" | ") for line in trap.tables._of_evidence(tmp_path)][2:]
    assert [row[:2] for row in rows] == [
        ["simulated arm, all changes", "11"], ["Lift, base of none", "9"], ["look, base of none", "9"],
    ]  # fmt: skip
    assert [row[2] for row in rows[1:]] == ["-1.00", "+1.00"]


def test_the_published_table_is_made_from_the_published_cells(trap: Any) -> None:
    results = ROOT / "benchmarks/results"
    rows = [line for line in trap.tables._of_evidence(results) if line.startswith("| simulated arm")]
    assert rows[0] in (results / "trap.md").read_text()
