"""Rows of benchmarks are written at once, and peak memory is measured alone."""

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
    table.add({"variant": "a", "ms": math.nan})
    assert json.loads(file.read_text()) == {"torch": "2", "rows": [{"variant": "a", "ms": None}]}
    table.write_unfinished({"variant": "b"})
    assert json.loads(file.read_text())["rows"][1:] == [{"variant": "b", "finished": False}]
    table.add({"variant": "b"})
    assert json.loads(file.read_text())["rows"][1:] == [{"variant": "b"}]
    assert list(file.parent.iterdir()) == [file]


def test_failed_part_gives_a_row_and_an_error_status_but_out_of_memory_is_a_result(
    load: Load, capsys: pytest.CaptureFixture[str]
) -> None:
    def runs_out() -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    table = load("rows").Rows(None)
    assert table.attempt(lambda: 3, variant="a") == 3
    assert table.attempt(runs_out, variant="b") is None
    table.finish()
    assert table.attempt([].pop, variant="c") is None
    with pytest.raises(SystemExit, match="1 of 2 rows failed") as end:
        table.finish()
    assert end.value.code not in {None, 0}
    output = capsys.readouterr()
    assert output.out.splitlines() == ["b, out of memory", "c, failed: IndexError: pop from empty list"]
    assert "Traceback" in output.err


# ---- memory ----


@pytest.mark.parametrize(
    ("program", "peak", "problem"),
    [
        ("print('hello'); print(1.5)", 1.5, None),
        ("import sys; sys.exit('no room')", None, "RuntimeError: the benchmark process exited with 1: no room"),
        (
            "import os; os.kill(os.getpid(), 9)",
            None,
            "RuntimeError: the benchmark process exited with -9: no error output",
        ),
        ("print('hello')", None, "JSONDecodeError: Expecting value: line 1 column 1 (char 0)"),
    ],
)
def test_cpu_peak_memory_is_measured_in_a_separate_process_even_if_it_fails(
    load: Load, program: str, peak: float | None, problem: str | None
) -> None:
    fields = load("memory").measure_peak_alone([].pop, ["-c", program], "cpu")
    assert fields == {"peak_gb": peak, "problem": problem and f"failed: {problem}"}
