"""Decisions: their values, their file and their summary agree."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from decisions import QUICK, STATE, image, make_plan_result
from tiny_models import tiny_model
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.decision import (
    PlanResult,
    summarize,
    write_plan,
)


def read(result: PlanResult, folder: Path) -> dict:
    def refuse(name: str) -> None:
        raise ValueError(name)

    path = write_plan(result, {"model": {"subject": "a model"}}, folder / "plan.json")
    return json.loads(path.read_text(), parse_constant=refuse)


def test_result_equals_the_decision_of_the_controller() -> None:
    result = make_plan_result()
    controller = Controller(tiny_model(), QUICK, seed=5)
    controller.reset(image(100))
    np.testing.assert_array_equal(controller.act(image(0), STATE), result.actions[0])
    assert result.zero_action_energy == pytest.approx(float(result.decision.cost(torch.zeros(1, 2, 7))[0]))
    assert result.states.shape == (3, 7)
    assert len(result.slices) == 3
    assert make_plan_result(nodes=0).slices == make_plan_result(nodes=2).slices == ()


def test_plan_file_contains_the_decision(tmp_path: Path) -> None:
    result = make_plan_result()
    file = read(result, tmp_path)
    plan = result.decision.plan
    assert file["format"] == 1
    assert file["model"] == {"subject": "a model"}
    assert (file["why"], file["seed"], file["crop"]) == ("planned", 5, "released")
    np.testing.assert_allclose(file["actions"], result.actions)
    np.testing.assert_allclose(file["states"], result.states)
    np.testing.assert_allclose(file["state"], STATE)
    assert file["energy"] == {
        "now": result.decision.current_energy, "began": result.decision.progress.initial_energy,
        "doing_nothing": result.zero_action_energy, "plan": plan.energy,
    }  # fmt: skip
    assert [iteration["lowest"] for iteration in file["iterations"]] == [
        iteration.lowest for iteration in plan.iterations
    ]
    np.testing.assert_allclose(file["iterations"][2]["std"], plan.iterations[2].std)
    assert PlanningConfig.model_validate_json(json.dumps(file["settings"])) == QUICK
    assert file["evaluations"] == plan.evaluations
    assert file["in_words"] == summarize(result)
    second = file["slices"][1]
    assert (second["across"], second["up"]) == ("dx", "dz")
    np.testing.assert_allclose(second["energy"], result.slices[1].energy)
    np.testing.assert_allclose(second["dz"], result.slices[1].up)


@pytest.mark.parametrize("zero_action_ratio", [0.5, 1.0 - 1e-7, 1.0, 2.0, np.nan])
@pytest.mark.parametrize("current_ratio", [0.8, 1.25])
def test_worse_than_names_exactly_the_references_with_lower_energy(
    tmp_path: Path, zero_action_ratio: float, current_ratio: float
) -> None:
    result = make_plan_result(nodes=0)
    energy = result.decision.plan.energy
    decision = replace(result.decision, current_energy=current_ratio * energy)
    result = replace(result, zero_action_energy=zero_action_ratio * energy, decision=decision)
    worse = [
        name for name, ratio in (("zero action", zero_action_ratio), ("current frame", current_ratio)) if ratio < 0.999
    ]
    assert read(result, tmp_path)["worse_than"] == worse
    sentences = {
        "zero action": f"zero action: energy {energy:.4f} against {energy / 2:.4f} (+100.0 %).",
        "current frame": f"current frame: energy {energy:.4f} against {0.8 * energy:.4f} (+25.0 %).",
    }
    assert result.worse_than == {
        name: f"The plan is predicted to be worse than the {sentences[name]}" for name in worse
    }


def test_model_without_finite_energies_gives_zero_action_and_writes_the_reason(tmp_path: Path) -> None:
    result = make_plan_result(broken=True)
    file = read(result, tmp_path)
    assert file["why"] == "no finite energy"
    assert not np.any(file["actions"])
    assert file["energy"]["plan"] is file["iterations"][0]["lowest"] is None
    assert file["iterations"][0]["finite"] == 0
    assert file["slices"] == []
    assert "no finite energy for any of 37 action sequences" in summarize(result)
