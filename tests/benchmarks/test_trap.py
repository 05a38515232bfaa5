"""The trap runs what can be run, and its tables keep what was measured of a cure that is gone."""

import json
import shutil
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

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
