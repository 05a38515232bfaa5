"""What the socket costs is counted; each way to give goals is another one, and what is done is not run again."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benches import imported
from vjepa2_ac.planning.session import load_to_plan
from vjepa2_ac.simulation.agent import agent_of_session
from vjepa2_ac.simulation.domains import named_domain
from vjepa2_ac.simulation.tasks import make_problem

pytest.importorskip("mujoco")

SMALL = ["planning.samples=6", "planning.iterations=1", "planning.cem.elites=3", "planning.limits.xyz=[0.05,0.05,0.05]"]


@pytest.fixture
def sub_goals(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark of goals."""
    yield from imported("sub_goals", monkeypatch)


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark of the socket."""
    yield from imported("serving", monkeypatch)


def test_each_way_gives_other_goals(sub_goals: Any) -> None:
    agent = agent_of_session(load_to_plan("builtin:sim-tiny", overrides=SMALL))
    options, problem = argparse.Namespace(task="pick", domain="A"), make_problem("pick", named_domain("A"), 3, 0)
    found = {}
    for way in set(sub_goals.WAYS) - {"alike"}:  # which needs data
        goals_of = None if way == "oracle" else sub_goals.goals_of(way, agent, options)
        goals = () if goals_of is None else goals_of(problem)
        found[way] = [(goal.at_least, goal.at_most, goal.share, goal.gripper) for goal in goals]
    assert found["single goal"] == found["oracle"] == []
    assert [mode for *_, mode in found["durations"]] == ["held", "close", "held"]
    assert [mode for *_, mode in found["durations, gripper planned"]] == [None, None, None]
    exact, slack = ([most for _, most, *_ in found[way]] for way in ("durations", "slack"))
    assert [b - a for a, b in zip(exact[:-1], slack[:-1], strict=True)] == [3, 3]
    assert [share for *_, share, _ in found["advance at 20%"]][:-1] == [0.2, 0.2]
    assert len(found["every step"]) > 6


def test_a_way_that_is_done_is_not_run_again(
    sub_goals: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--episodes", "2", "--only", "oracle", "--folder", str(tmp_path), "--out", str(tmp_path / "table.md")]
    monkeypatch.setattr("sys.argv", ["sub_goals.py", "builtin:sim-tiny", *SMALL[:2], *out, *SMALL[2:]])
    sub_goals.main()
    assert "| oracle | 100% [34%, 100%] | 0." in capsys.readouterr().out
    monkeypatch.setattr(sub_goals, "measure", None)
    sub_goals.main()
    assert "| oracle | 100% [34%, 100%] | 0." in (tmp_path / "table.md").read_text()


def test_the_socket_costs_something_and_less_than_the_round_trip(
    served: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "sys.argv", ["serving.py", "--decisions", "4", "--size", "48", "60", "--json", str(tmp_path / "f")]
    )
    served.main()
    figures = dict(line.split(": ") for line in capsys.readouterr().out.splitlines())
    assert 0 < float(figures["cost_ms_p50"]) < float(figures["round_trip_ms_p50"])
    assert np.isfinite(float(figures["cost_ms_p99"]))
    assert (tmp_path / "f").read_text().count("cost_ms_p95") == 1


def test_a_near_goals_lowest_energy_by_true_images_is_on_the_way(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for first_step in imported("first_step", monkeypatch):
        monkeypatch.setattr("sys.argv", ["first_step.py", "builtin:sim-tiny", "--episodes", "2"])
        first_step.main()
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[:2] for row in rows] == [
        [goal, step] for goal in ("far", "near") for step in ("way to it", "true images", "model")
    ]
    down = {(row[0], row[1]): float(row[3]) for row in rows}
    assert down["far", "way to it"] > 5  # the grasp is below the hand
    off = {row[1]: float(row[4]) for row in rows if row[0] == "near" and len(row) > 4}
    assert off["true images"] < 2.5
