"""Benchmarks that nobody runs every day still run, and compare only what computes the same."""

import json
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from benches import ELSEWHERE, imported


@pytest.fixture
def train_step(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark of a training step."""
    yield from imported("train_step", monkeypatch)


def rows(printed: str) -> list[tuple[str, float, str]]:
    """Return way, milliseconds and ratio of each line of the table."""
    line = r"^ +\d+ +\d+ +(?:yes|no) +(?:cache|pixels) +(\S+) +(\S+) +(\S+) +\S+ +\S+% +0 +(\S+)"
    found = re.findall(line, printed, re.MULTILINE)
    assert all(float(least) <= float(median) for _, median, least, _ in found)
    return [(way, float(median), ratio) for way, median, _, ratio in found]


def test_quick_benchmark_of_a_training_step_completes_without_the_official_code(
    train_step: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train_step.main(
        ["--quick", "--no-memory", "--encoder", "--checkpointing", "off", "on", "--official", str(tmp_path)]
    )
    printed = capsys.readouterr().out
    assert f"official: skipped, for there is no {tmp_path}" in printed
    assert [way for way, _, _ in rows(printed)] == ["dense", "auto"] * 2
    assert [ratio for _, _, ratio in rows(printed)][::2] == ["1.00", "1.00"]


def test_all_rows_of_a_training_step_come_from_one_command_and_what_runs_out_of_memory_says_so(
    train_step: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = sys.modules["train_step_variants"].Bench
    usual = bench.step

    def step(self: Any, setting: Any, way: str) -> Any:
        if setting.encoder and way == "per_step":
            raise torch.OutOfMemoryError
        return usual(self, setting, way)

    monkeypatch.setattr(bench, "step", step)
    file = tmp_path / "results" / "steps.json"
    train_step.main([
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


def test_the_batch_that_was_found_is_a_row_and_is_timed(
    train_step: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(train_step.QUICK, "batch", ["largest"])  # on a CPU: 2
    file = tmp_path / "steps.json"
    train_step.main(["--quick", "--no-memory", "--official", str(tmp_path), "--json", str(file)])
    assert re.search(r"^ +4 +2 +no +cache +auto +is the largest batch", capsys.readouterr().out, re.MULTILINE)
    found = [(row["measured"], row["batch"]) for row in json.loads(file.read_text())["rows"]]
    assert found == [("largest batch", 2), ("time", 2), ("time", 2)]


def test_no_ratio_is_printed_to_a_predictor_that_computes_something_else(
    train_step: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "src" / "models").mkdir(parents=True)
    (tmp_path / "src" / "models" / "ac_predictor.py").write_text(ELSEWHERE)
    train_step.main(["--quick", "--no-memory", "--official", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "official: NO RATIO" in printed
    assert [way for way, _, _ in rows(printed)] == ["dense", "auto"]


@pytest.fixture
def numerics(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The comparison of what ways learn."""
    yield from imported("numerics", monkeypatch)


def test_ways_learn_the_same_and_one_that_does_not_is_found(
    numerics: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    numerics.main(["--quick"])
    printed = capsys.readouterr().out
    assert re.search(r"^per_step: strays by \S+ in 2 steps", printed, re.MULTILINE)
    assert re.search(r"^bfloat16: \S+ after 16 predictions", printed, re.MULTILINE)
    from vjepa2_ac.model.network import attention

    wrong = {**attention._IMPLEMENTATIONS, "per_step": lambda *given: attention._dense(*given) * 1.1}
    monkeypatch.setattr(attention, "_IMPLEMENTATIONS", wrong)
    with pytest.raises(SystemExit, match="beyond its tolerance"):
        numerics.main(["--quick"])


@pytest.fixture
def latents(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark of the latent cache."""
    yield from imported("latents", monkeypatch)


def test_latents_that_cannot_be_timed_are_a_row_and_sizes_and_errors_follow(
    latents: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(latents, "record_dataset", fails)
    file = tmp_path / "latents.json"
    with pytest.raises(SystemExit, match="3 of 6 rows failed"):
        latents.main(["--quick", "--json", str(file)])
    found = json.loads(file.read_text())["rows"]
    assert [row["measured"] for row in found] == ["speed", *["size"] * 3, "reads of a clip", "added error"]
    assert {row.get("problem") for row in found} == {None, "failed: OSError: disk full"}


def test_quick_benchmark_of_latents_tells_speed_size_and_added_error(
    latents: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco", reason="the arm is simulated")
    file = tmp_path / "latents.json"
    latents.main(["--quick", "--json", str(file)])
    printed = capsys.readouterr().out
    rows = json.loads(file.read_text())["rows"]
    parts = {"encoder alone": 1, "speed": 1, "size": 3, "reads of a clip": 8, "added error": 3}
    assert Counter(row["measured"] for row in rows) == parts
    reads = [row for row in rows if row["measured"] == "reads of a clip"]
    for here, there in zip(reads[::2], reads[1::2], strict=True):
        assert (here["place"], there["place"], there["mb"]) == ("folder", "bucket", here["mb"])
        assert 0 < there["reads"] <= here["reads"], "neighbouring frames are one request"
    assert all(row["order"] == 1 for row in rows if row.get("stored_as") == "fp32" and "order" in row)
    speed = r"^ +4 +\d+\.\d+ +\d+\.\d% +\d+\.\d+ +\d+%( +\d+ +\d+ +\d+ +\d+) +\d+\.\d\dx$"
    (times,) = re.findall(speed, printed, re.MULTILINE)
    pictures, least, latents, least_of_latents = map(int, times.split())
    assert 0 < least <= pictures
    assert 0 < least_of_latents <= latents
    hours = [float(hour) for hour in re.findall(r"^ +(?:int8|bf16|fp32) +\S+ +(\d\.\d\d) +\S+$", printed, re.MULTILINE)]
    bf16, fp32, int8 = hours
    assert int8 < bf16 < fp32
    added = re.findall(r"^ +random +(\w+) +\S+ +(\S+)% +\S+ +(\S+)%", printed, re.MULTILINE)
    assert [kind for kind, *_ in added] == ["fp32", "bf16", "int8"]
    assert all(float(one) == 0 for kind, *percent in added if kind == "fp32" for one in percent)
    assert all(abs(float(one)) < 2 for _, *percent in added for one in percent)


def test_a_decoder_is_timed_beside_the_linear_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for bench in imported("decoder", monkeypatch):
        bench.main(["--quick", "--json", str(tmp_path / "rows.json")])
    found = re.findall(r"^(linear|tiny) +(show|learn) +\S+ +\S+ +(\S+) +-$", capsys.readouterr().out, re.MULTILINE)
    assert [row[:2] for row in found] == [("linear", "show"), ("tiny", "show"), ("linear", "learn"), ("tiny", "learn")]
    assert [ratio for way, _, ratio in found if way == "linear"] == ["1.00", "1.00"]
    assert len(json.loads((tmp_path / "rows.json").read_text())["rows"]) == 4
