"""Decisions: their values, their file and their summary agree."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from decisions import QUICK, STATE, asked, image
from tiny_models import tiny_model
from vjepa2_ac.config.component import Component
from vjepa2_ac.config.planning import EnergyConfig, LimitsConfig, PlanningConfig
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.decision import (
    PlanRequest,
    PlanResult,
    axes_at_limit,
    decide,
    summarize,
    write_plan,
)
from vjepa2_ac.planning.energy import WorldModelCost
from vjepa2_ac.planning.goals import equal_durations, timed


def read(found: PlanResult, folder: Path) -> dict:
    def refuse(name: str) -> None:
        raise ValueError(name)

    path = write_plan(found, {"model": {"subject": "a model"}}, folder / "plan.json")
    return json.loads(path.read_text(), parse_constant=refuse)


def test_an_answer_is_what_the_controller_decides() -> None:
    found = asked()
    controller = Controller(tiny_model(), QUICK, seed=5)
    controller.reset(image(100))
    np.testing.assert_array_equal(controller.act(image(0), STATE), found.actions[0])
    assert found.doing_nothing == pytest.approx(float(found.decision.cost(torch.zeros(1, 2, 7))[0]))
    assert found.states.shape == (3, 7)
    assert len(found.slices) == 3
    assert asked(nodes=0).slices == asked(nodes=2).slices == ()


@pytest.mark.parametrize("planner", ["cem", "gradient"])
@pytest.mark.parametrize(("iterations", "nodes"), [(1, 0), (7, 5), (14, 7)])
def test_maps_evaluate_no_more_than_the_search_and_without_them_nothing_is_but_no_motion(
    monkeypatch: pytest.MonkeyPatch, planner: str, iterations: int, nodes: int
) -> None:
    evaluated: list[int] = []
    once = WorldModelCost.__call__

    def counted(cost: WorldModelCost, actions: torch.Tensor) -> torch.Tensor:
        evaluated.append(len(actions))
        return once(cost, actions)

    monkeypatch.setattr(WorldModelCost, "__call__", counted)
    options = {"starts": 12} if planner == "gradient" else {"elites": 4} if planner in {"cem", "icem"} else {}
    settings = {"planner": Component(planner, options), "iterations": iterations}
    plain, mapped = asked(nodes=0, **settings), asked(nodes=None, **settings)
    for found in (plain, mapped):
        searched = found.decision.plan.evaluations
        while searched > 0:
            searched -= evaluated.pop(0)
        assert searched == 0
        assert evaluated.pop(0) == 1, "no motion"
        assert sum(evaluated.pop(0) for _ in found.slices) <= 12 * iterations
    assert evaluated == []
    assert plain.slices == ()
    assert [one.energy.shape for one in mapped.slices] == [(nodes, nodes)] * (3 if nodes else 0)
    np.testing.assert_array_equal(plain.actions, mapped.actions)


def test_the_file_holds_the_decision(tmp_path: Path) -> None:
    found = asked()
    file = read(found, tmp_path)
    plan = found.decision.plan
    assert file["format"] == 1
    assert file["model"] == {"subject": "a model"}
    assert (file["why"], file["seed"], file["crop"]) == ("planned", 5, "released")
    np.testing.assert_allclose(file["actions"], found.actions)
    np.testing.assert_allclose(file["states"], found.states)
    np.testing.assert_allclose(file["state"], STATE)
    assert file["energy"] == {
        "now": found.decision.energy_now, "began": found.decision.progress.began, "doing_nothing": found.doing_nothing,
        "plan": plan.energy,
    }  # fmt: skip
    assert [one["lowest"] for one in file["iterations"]] == [one.lowest for one in plan.iterations]
    np.testing.assert_allclose(file["iterations"][2]["std"], plan.iterations[2].std)
    assert PlanningConfig.model_validate_json(json.dumps(file["settings"])) == QUICK
    assert file["evaluations"] == plan.evaluations
    assert file["in_words"] == summarize(found)
    second = file["slices"][1]
    assert (second["across"], second["up"]) == ("dx", "dz")
    np.testing.assert_allclose(second["energy"], found.slices[1].energy)
    np.testing.assert_allclose(second["dz"], found.slices[1].up)


@pytest.mark.parametrize("still", [0.5, 1.0 - 1e-7, 1.0, 2.0, np.nan])
@pytest.mark.parametrize("now", [0.8, 1.25])
def test_a_plan_is_called_worse_than_exactly_the_lower_energies(tmp_path: Path, still: float, now: float) -> None:
    found = asked(nodes=0)
    energy = found.decision.plan.energy
    decision = replace(found.decision, energy_now=now * energy)
    found = replace(found, doing_nothing=still * energy, decision=decision)
    worse = [name for name, share in (("zero action", still), ("current frame", now)) if share < 0.999]
    assert read(found, tmp_path)["worse_than"] == worse
    said = {
        "zero action": f"zero action: energy {energy:.4f} against {energy / 2:.4f} (+100.0 %).",
        "current frame": f"current frame: energy {energy:.4f} against {0.8 * energy:.4f} (+25.0 %).",
    }
    assert found.worse_than == {name: f"The plan is predicted to be worse than the {said[name]}" for name in worse}


def test_at_the_goal_nothing_is_done_and_the_summary_says_so(tmp_path: Path) -> None:
    found = asked(7, start=7)
    assert summarize(found).startswith("Zero action: the current frame has the latents of the goal")
    file = read(found, tmp_path)
    assert file["why"] == "at the goal"
    assert not np.any(file["actions"])
    np.testing.assert_allclose(file["states"], np.tile(STATE, (3, 1)))
    assert file["energy"]["plan"] is file["energy"]["doing_nothing"] is None
    assert file["iterations"] == file["slices"] == []


def test_a_broken_model_does_nothing_and_the_file_says_why(tmp_path: Path) -> None:
    found = asked(broken=True)
    file = read(found, tmp_path)
    assert file["why"] == "no finite energy"
    assert not np.any(file["actions"])
    assert file["energy"]["plan"] is file["iterations"][0]["lowest"] is None
    assert file["iterations"][0]["finite"] == 0
    assert file["slices"] == []
    assert "no finite energy for any of 37 action sequences" in summarize(found)


def test_goals_without_a_part_in_the_plan_are_named() -> None:
    last = asked(100, 101)
    assert last.decision.goals == (0, 1)
    assert last.unused_goals == (0,)
    assert "Goal 1 does not affect this plan" in summarize(last)
    summed = asked(100, 101, energy=EnergyConfig(steps="sum"))
    assert summed.unused_goals == ()
    assert "oal" not in summarize(summed)
    assert asked(100, 101, 102, energy=EnergyConfig(steps="sum")).unused_goals == (2,)


def test_goals_share_the_horizon_by_default() -> None:
    assert equal_durations(6, 3) == (2, 2)
    assert equal_durations(1, 3) == (1, 1)


def test_what_a_person_should_know_of_a_plan_is_said() -> None:
    found = asked(limits=LimitsConfig(xyz=(0.05, 0.0, 0.05)))
    found.actions[0, :3] = (-0.0495, 0.0, 0.048)
    assert axes_at_limit(found) == ["dx"]
    assert "at its limit along dx (" in summarize(found)
    ticks = iter(range(1000))
    controller = Controller(tiny_model(), QUICK.model_copy(update={"budget_s": 4.0}))
    controller.planner.clock = lambda: float(next(ticks))
    assert "Time was up after" in summarize(decide(controller, PlanRequest(image(0), STATE, timed([image(100)], ()))))
