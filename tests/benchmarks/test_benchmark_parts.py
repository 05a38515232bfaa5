"""Rows of benchmarks outlive them, and memory is measured alone."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

Load = Callable[[str], Any]


# ---- rows ----


def test_each_row_is_written_at_once_and_unfinished_results_are_marked(load: Load, tmp_path: Path) -> None:
    file = tmp_path / "results" / "rows.json"
    table = load("rows").Rows(file, torch="2")
    table.add({"way": "a", "ms": math.nan})
    assert json.loads(file.read_text()) == {"torch": "2", "rows": [{"way": "a", "ms": None}]}
    table.so_far({"way": "b"})
    assert json.loads(file.read_text())["rows"][1:] == [{"way": "b", "finished": False}]
    table.add({"way": "b"})
    assert json.loads(file.read_text())["rows"][1:] == [{"way": "b"}]
    assert list(file.parent.iterdir()) == [file]


def test_failed_part_gives_a_row_and_an_error_status_but_out_of_memory_is_a_result(
    load: Load, capsys: pytest.CaptureFixture[str]
) -> None:
    def runs_out() -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    table = load("rows").Rows(None)
    assert table.attempt(lambda: 3, way="a") == 3
    assert table.attempt(runs_out, way="b") is None
    table.finish()
    assert table.attempt([].pop, way="c") is None
    with pytest.raises(SystemExit, match="1 of 2 rows failed") as end:
        table.finish()
    assert end.value.code not in {None, 0}
    said = capsys.readouterr()
    assert said.out.splitlines() == ["b, out of memory", "c, failed: IndexError: pop from empty list"]
    assert "Traceback" in said.err


# ---- memory ----


@pytest.mark.parametrize(
    ("program", "peak", "problem"),
    [
        ("print('hello'); print(1.5)", 1.5, None),
        ("import sys; sys.exit('no room')", None, "RuntimeError: a process of its own ended with 1: no room"),
        (
            "import os; os.kill(os.getpid(), 9)",
            None,
            "RuntimeError: a process of its own ended with -9: it says nothing",
        ),
        ("print('hello')", None, "JSONDecodeError: Expecting value: line 1 column 1 (char 0)"),
    ],
)
def test_cpu_peak_memory_is_measured_in_a_separate_process_even_if_it_fails(
    load: Load, program: str, peak: float | None, problem: str | None
) -> None:
    found = load("memory").peak_alone([].pop, ["-c", program], "cpu")
    assert found == {"peak_gb": peak, "problem": problem and f"failed: {problem}"}
