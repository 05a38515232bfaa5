"""The benchmark of a training step runs, and compares only what computes the same."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from benches import ELSEWHERE


def rows(printed: str) -> list[tuple[str, float, str]]:
    """Return way, milliseconds and ratio of each line of the table."""
    line = r"^ +\d+ +\d+ +(?:yes|no) +(?:cache|pixels) +(\S+) +(\S+) +(\S+) +\S+ +\S+% +0 +(\S+)"
    found = re.findall(line, printed, re.MULTILINE)
    assert all(float(least) <= float(median) for _, median, least, _ in found)
    return [(way, float(median), ratio) for way, median, _, ratio in found]


def test_quick_benchmark_of_a_training_step_completes_without_the_official_code(
    load: Callable[[str], Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    load("train_step").main(
        ["--quick", "--no-memory", "--encoder", "--checkpointing", "off", "on", "--official", str(tmp_path)]
    )
    printed = capsys.readouterr().out
    assert f"official: skipped, for there is no {tmp_path}" in printed
    assert [way for way, _, _ in rows(printed)] == ["dense", "auto"] * 2
    assert [ratio for _, _, ratio in rows(printed)][::2] == ["1.00", "1.00"]


def test_all_rows_of_a_training_step_come_from_one_command_and_what_runs_out_of_memory_says_so(
    load: Callable[[str], Any], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = load("train_step_variants").Bench
    usual = bench.step

    def step(self: Any, setting: Any, way: str) -> Any:
        if setting.encoder and way == "per_step":
            raise torch.OutOfMemoryError
        return usual(self, setting, way)

    monkeypatch.setattr(bench, "step", step)
    file = tmp_path / "results" / "steps.json"
    load("train_step").main([
        "--quick", "--no-memory", "--official", str(tmp_path), "--source", "cache", "pixels", "--attention", "per_step",
        "--profile", "--cap-gb", "24", "--json", str(file),
    ])  # fmt: skip
    printed = capsys.readouterr().out
    assert re.search(r"^ +4 +1 +no +pixels +per_step +out of memory$", printed, re.MULTILINE)
    found = [(row["encoder"], row["way"], row["problem"]) for row in json.loads(file.read_text())["rows"]]
    assert found == [
        (False, "dense", None), (False, "per_step", None), (True, "dense", None), (True, "per_step", "out of memory"),
    ]  # fmt: skip
    first = json.loads(file.read_text())["rows"][0]
    assert first["repeats"] == 1
    assert first["min_s"] == first["s"] > 0
    assert first["waits"] > 0
    assert first["first_s"] > 0
    assert first["compiled_after"] == 0


def test_no_ratio_is_printed_to_a_predictor_that_computes_something_else(
    load: Callable[[str], Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "src" / "models").mkdir(parents=True)
    (tmp_path / "src" / "models" / "ac_predictor.py").write_text(ELSEWHERE)
    load("train_step").main(["--quick", "--no-memory", "--official", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "official: NO RATIO" in printed
    assert [way for way, _, _ in rows(printed)] == ["dense", "auto"]
