"""Rows of benchmarks are written at once, and peak memory is measured alone."""

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
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


# ---- versions of MuJoCo ----


class FakeWorld:
    """An environment like that of libero.py: an action moves the object, by a distance that depends on the version."""

    goals = (("on", "bowl", "plate"),)

    def __init__(self, gain: float) -> None:
        self.env, self.gain = SimpleNamespace(step=self.move), gain

    def reset(self, seed: int) -> tuple[np.ndarray, dict[str, bool]]:
        self.object = np.array([0.1 * seed, 0.0, 0.0])
        return self.object, self.info()

    def move(self, action: np.ndarray) -> None:
        self.object = self.object + self.gain * action

    def step(self, target: None) -> tuple[dict[str, bool]]:  # noqa: ARG002
        self.env.step(np.array([0.0, 0.0, 0.01]))
        return (self.info(),)

    def info(self) -> dict[str, bool]:
        return {"success": bool(self.object[2] > 0.045)}

    def at(self, name: str) -> np.ndarray:
        assert name == "bowl"
        return self.object

    def render(self) -> np.ndarray:
        return np.full((4, 4, 3), 100 if self.gain == 1.0 else 110, dtype=np.uint8)


def test_replay_in_its_own_version_has_no_difference_and_in_another_version_it_has(
    load: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = load("mujoco_versions")
    for mujoco, gain in (("3", 1.0), ("4", 0.2)):
        monkeypatch.setattr(module, "open_world", lambda *_, gain=gain: FakeWorld(gain))
        monkeypatch.setattr(module, "version", lambda _, mujoco=mujoco: mujoco)
        monkeypatch.setattr(sys, "argv", ["mujoco_versions", str(tmp_path), "libero", "suite"])
        module.main()
    monkeypatch.setattr(sys, "argv", ["mujoco_versions", str(tmp_path)])
    module.main()
    rows = capsys.readouterr().out.splitlines()
    same, nothing = "10 of 10 | 10 of 10", "0.0 (at most 0.0)"
    assert rows[2] == f"| suite | MuJoCo 3 | MuJoCo 3 | {same} | {nothing} | {nothing} | 0.00 | 0.0 % |"
    assert rows[3] == (
        f"| suite | MuJoCo 3 | MuJoCo 4 | 10 of 10 | 0 of 10 | {nothing} | 120.0 (at most 120.0) | 10.00 | 100.0 % |"
    )
    assert rows[4] == f"| suite | MuJoCo 4 | MuJoCo 4 | {same} | {nothing} | {nothing} | 0.00 | 0.0 % |"
