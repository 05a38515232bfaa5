"""What the pages on planning show works, and what they list is all there is."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from paths import ROOT
from vjepa2_ac.cli import main
from vjepa2_ac.media.images import read_image

PAGE = (ROOT / "docs/planning.md").read_text()
REFERENCE = (ROOT / "docs/planning_reference.md").read_text()
START = [0.498, -0.111, 0.211, 3.142, 0.0, -1.175, 0.0]


class Robot:
    """Stands still, and sees the goal after two commands."""

    def __init__(self) -> None:
        self.targets: list[np.ndarray] = []

    def state(self) -> np.ndarray:
        return np.array(START)

    def image(self) -> np.ndarray:
        return read_image(ROOT / f"docs/plan_{'start' if len(self.targets) < 2 else 'goal'}.png")

    def move_to(self, target: np.ndarray) -> None:
        self.targets.append(target)


def test_the_robots_loop_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (loop,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    robot = Robot()
    monkeypatch.chdir(ROOT)
    loop = loop.replace("samples=100", "samples=24").replace("iterations=4", "iterations=2")
    exec(loop, {"robot": robot})  # noqa: S102 - our own page
    assert len(robot.targets) == 2
    moved = np.stack(robot.targets)[:, :3] - START[:3]
    assert (np.abs(moved) <= 0.05 + 1e-9).all()
    assert moved[0, 2] > 0  # up, where the goal is
    assert capsys.readouterr().out.splitlines()[-1].startswith("at the goal")


def test_the_command_runs_and_writes_what_the_page_lists(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = PAGE.split("```sh\n")[1].split("```")[0].replace("\\\n", " ")
    shown = shown.replace("samples=200", "samples=12").replace("iterations=5", "iterations=1")
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("vjepa2_ac.reports.planning_figures.plot_plan", lambda _, path, *__: path)
    words = shlex.split(shown)
    assert words[0] == "vjepa2-ac"
    assert main([*words[1:], "--out", str(tmp_path), "--nodes", "3"]) == 0
    assert "Plan of 1 model step" in capsys.readouterr().out
    table = REFERENCE.split("## plan.json")[1].split("##")[0]
    named = set(re.findall(r"`([a-z_]+)`", "\n".join(row.split("|")[1] for row in table.splitlines() if "|" in row)))
    file = json.loads((tmp_path / "plan.json").read_text())
    assert set(file) == named
    for section in ("model", "energy", "seconds"):
        (row,) = (row for row in table.splitlines() if row.startswith(f"| `{section}`"))
        assert set(file[section]) <= set(re.findall(r"`([a-z_]+)`", row)), section
