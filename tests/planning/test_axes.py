"""Calibrated axes rotate the model's input but not the limits; unusable files of axes raise."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from adapted_run import write_adapted_run
from decisions import STATE, image, make_controller
from tiny_models import actions, goal, scene, tiny_model
from vjepa2_ac.config import Config
from vjepa2_ac.config.planning import EnergyConfig, LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.inspection.axes import ANGLES_DEGREES, fit_axes
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.energy import AxesRotation, WorldModelCost
from vjepa2_ac.planning.model_setup import load_for_planning
from vjepa2_ac.planning.settings import read_axes
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.spaces import apply_actions

TURN = AxesRotation(math.radians(43.0))


def random_numbers(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed)) * 0.8


def write_axes(path: Path, model: WorldModel, degrees: float = 43.0, **changes: Any) -> str:
    values = {
        "format": 1,
        **{name: {"value": value, "low": value - 1, "high": value + 1} for name, value in
           {"yaw_degrees": degrees, "error": 0.9}.items()},
        "pairs": 200,
        "episodes": 20,
        "problem": None,
        "model": {"subject": "tiny", **model.fingerprints()._asdict()},
    }  # fmt: skip
    path.write_text(json.dumps(values | changes))
    return str(path)


def test_rotated_actions_lead_to_rotated_states() -> None:
    """Rotating the result of an action equals applying the rotated action to the rotated state."""
    states, samples = random_numbers(50, 7), random_numbers(50, 7, seed=1) - 0.4
    torch.testing.assert_close(
        apply_actions(TURN.rotate_poses(states), TURN.rotate_actions(samples)),
        TURN.rotate_poses(apply_actions(states, samples)),
        atol=1e-5, rtol=0,
    )  # fmt: skip


def test_rotation_is_counterclockwise_from_above_and_keeps_height_and_gripper() -> None:
    quarter = AxesRotation(math.pi / 2)
    turned = quarter.rotate_actions(torch.tensor([0.03, 0.0, 0.02, 0.0, 0.0, 0.1, 0.5]))
    torch.testing.assert_close(turned, torch.tensor([0.0, 0.03, 0.02, 0.0, 0.0, 0.1, 0.5]), atol=1e-6, rtol=0)
    posed = quarter.rotate_poses(torch.tensor([0.4, 0.1, 0.3, 0.0, 0.0, 0.1, 0.5]))
    expected = torch.tensor([-0.1, 0.4, 0.3, 0.0, 0.0, 0.1 + math.pi / 2, 0.5])
    torch.testing.assert_close(posed, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("extrinsics", [False, True])
def test_energy_with_axes_equals_energy_of_rotated_actions_and_states(extrinsics: bool) -> None:
    model, start, samples = tiny_model(extrinsics=extrinsics), scene(extrinsics=extrinsics), actions(6, 2)
    plain = replace(
        start,
        state=TURN.rotate_poses(start.state),
        extrinsics=None if start.extrinsics is None else TURN.rotate_poses(start.extrinsics),
    )
    with torch.no_grad():
        turned = WorldModelCost(model, replace(start, axes_rotation=TURN), goal(), EnergyConfig())(samples)
        expected = WorldModelCost(model, plain, goal(), EnergyConfig())(TURN.rotate_actions(samples))
        untouched = WorldModelCost(model, start, goal(), EnergyConfig())(samples)
    torch.testing.assert_close(turned, expected, atol=1e-5, rtol=0)
    assert not torch.allclose(turned, untouched, atol=1e-4)


def test_limits_apply_to_executed_actions_with_calibrated_axes(tmp_path: Path) -> None:
    """The limits form a long thin box; actions rotated by 43 degrees would exceed them."""
    model = tiny_model()
    limits = LimitsConfig(xyz=(0.05, 0.002, 0.05))
    plans = []
    for axes in (None, write_axes(tmp_path / "axes.json", model)):
        controller = make_controller(model, axes=axes, limits=limits)
        controller.reset(image(100))
        planned = np.stack([controller.act(image(seed), STATE) for seed in range(3)])
        assert (np.abs(planned[:, :3]) <= limits.xyz).all()
        plans.append(planned)
    assert not np.allclose(*plans), "the model receives rotated actions"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"problem": "uncertain: yaw 30 degrees"}, "uncertain: yaw 30 degrees"),
        ({"format": 7}, r"format: .*\(found 7\)"),
        ({"yaw_degrees": {"value": "north", "low": None, "high": None}}, r"yaw_degrees\.value"),
    ],
)
def test_unusable_axes_file_raises(tmp_path: Path, changes: dict, message: str) -> None:
    model = tiny_model()
    path = write_axes(tmp_path / "axes.json", model, **changes)
    with pytest.raises(InputError, match=f"(?s)planning.axes.*{message}"):
        make_controller(model, axes=path)


def test_axes_of_another_model_or_missing_file_raise(tmp_path: Path) -> None:
    model, other = tiny_model(), tiny_model()
    with torch.no_grad():
        other.base_predictor.predictor_proj.weight.add_(0.1)
    with pytest.raises(InputError, match="calibrated for another model, tiny"):
        make_controller(model, axes=write_axes(tmp_path / "axes.json", other))
    with pytest.raises(InputError, match=r"no/axes\.json: cannot be read"):
        make_controller(model, axes="no/axes.json")


def test_run_accepts_axes_calibrated_for_its_trained_weights(make_config: Any, tmp_path: Path) -> None:
    config: Config = make_config(planning={"samples": 12, "iterations": 2})
    run = write_adapted_run(config)
    loaded = load_subject(run)
    path = write_axes(tmp_path / "axes.json", loaded.world_model)
    base_axes = write_axes(tmp_path / "base.json", WorldModel.from_pretrained(str(config.model.base)))
    subject = load_for_planning(str(run), overrides=[f"planning.axes={path}"])
    Controller.of_subject(subject)
    Controller.of_run(loaded, config.planning.model_copy(update={"axes": path}))
    with pytest.raises(InputError, match="calibrated for another model"):
        Controller.of_subject(load_for_planning(str(run), overrides=[f"planning.axes={base_axes}"]))


def test_calibration_output_can_be_read(tmp_path: Path) -> None:
    errors = 1.1 - np.cos(np.deg2rad(np.array(ANGLES_DEGREES) - 90.0))
    fit = fit_axes(np.tile(errors, (40, 1)), [f"{index // 4}" for index in range(40)])
    assert fit.problem is None
    model = tiny_model()
    path = write_axes(tmp_path / "axes.json", model, **json.loads(json.dumps(fit.as_dict())))
    assert read_axes(path).yaw_degrees == pytest.approx(90.0, abs=1e-4)
