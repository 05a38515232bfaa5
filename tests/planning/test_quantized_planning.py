"""Plans in 8 bits are nearly the plain ones, and the model that was given stays as it was."""

import importlib.util
import sys

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from planning.tiny import actions, cost, tiny_model
from vjepa2_ac.config.planning import CemConfig, GradientConfig, PlanningConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.ready import make_ready

with_torchao = pytest.mark.skipif(
    importlib.util.find_spec("torchao") is None, reason="torchao (extra quantize) is not installed"
)
PLAIN = PlanningConfig(samples=64, iterations=3, cem=CemConfig(elites=8))
INT8 = PLAIN.model_copy(update={"quantize": "int8"})


@with_torchao
@torch.no_grad()
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("adapted", [False, True])
def test_energies_in_8_bits_are_nearly_the_plain_ones(adapted: bool, dtype: torch.dtype) -> None:
    model, tried = tiny_model(adapted=adapted), actions(50, 3)
    model.base_predictor.to(dtype)
    before = cost(model)(tried)
    smaller = make_ready(model, INT8)
    assert smaller.encoder is model.encoder
    assert smaller.adaptation is None
    energies = cost(smaller)(tried)
    assert not torch.equal(energies, before)
    assert (energies - before).norm() < 0.05 * before.norm()
    assert torch.corrcoef(torch.stack([energies, before]))[0, 1] > 0.9
    assert torch.equal(cost(model)(tried), before)  # the given model is as it was
    assert (model.adaptation is not None) == adapted


@with_torchao
def test_a_controller_plans_in_8_bits() -> None:
    pictures = np.random.default_rng(0).integers(0, 256, (3, 48, 48, 3), dtype=np.uint8)
    state, model, found = np.array([0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2]), tiny_model(adapted=True), []
    for config in (PLAIN, INT8, INT8):
        run = Controller(model, config)
        run.reset(pictures[0])
        found.append([run.act(picture, state) for picture in pictures[1:]])
    np.testing.assert_array_equal(found[1], found[2])
    np.testing.assert_allclose(found[1], found[0], atol=0.03)
    assert not np.array_equal(found[1], found[0])


@with_torchao
def test_fp8_needs_a_device_that_has_it() -> None:
    with pytest.raises(InputError, match=r"fp8, on cpu.*compute capability 8\.9.*planning\.quantize=int8 or off"):
        Controller(tiny_model(), PLAIN.model_copy(update={"quantize": "fp8"}))


def test_without_its_library_the_way_out_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "torchao"] or ["torchao"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"torchao is not installed.*\.\[quantize\]"):
        Controller(tiny_model(), INT8)


def test_gradients_are_not_in_8_bits() -> None:
    with pytest.raises(ValidationError, match="planner gradient needs gradients"):
        PlanningConfig(planner="gradient", gradient=GradientConfig(starts=2), quantize="int8")
