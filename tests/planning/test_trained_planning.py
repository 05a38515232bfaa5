"""A trained model plans like its base: merged, in the type of its weights, and without being changed."""

import copy

import numpy as np
import pytest
import torch

from decisions import STATE
from tiny_models import actions, cost, tiny_model
from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning import controller
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.model_setup import prepare_for_planning

PLAIN = PlanningConfig(samples=16, iterations=2, horizon=2, planner={"name": "cem", "options": {"elites": 4}})
ADAPTERS = {
    "lora": AdapterConfig(rank=4, alpha=8.0, dropout=0.1),
    "heads": AdapterConfig(rank=4, alpha=8.0, modules_to_save=("predictor_embed", "predictor_proj", "action_encoder")),
    "dora": AdapterConfig(rank=4, alpha=8.0, dora=True),
    "none": AdapterConfig(kind="none"),
}
every_adapter = pytest.mark.parametrize("adapter", ADAPTERS.values(), ids=ADAPTERS)
PRODUCTS = ("mm", "addmm", "bmm", "baddbmm")


def trained_model(adapter: AdapterConfig, dtype: torch.dtype = torch.float32) -> WorldModel:
    """Return a tiny model in which all that is trained was moved."""
    model = tiny_model().to(dtype)
    add_adapter(model, adapter, seed=0)
    generator = torch.Generator().manual_seed(2)
    for value in model.parameters():
        if value.requires_grad:
            value.data += 0.02 * torch.randn(value.shape, generator=generator)
    return model.eval()


def decided(model: WorldModel, config: PlanningConfig = PLAIN) -> list[np.ndarray]:
    images = np.random.default_rng(0).integers(0, 256, (3, 48, 48, 3), dtype=np.uint8)
    run = Controller(model, config)
    run.reset(images[0])
    return [run.act(image, STATE) for image in images[1:]]


@every_adapter
def test_the_same_is_decided_as_by_the_model_that_was_trained(
    adapter: AdapterConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, tried = trained_model(adapter), actions(20, 2)
    with torch.no_grad():
        expected, of_base = cost(model)(tried), cost(tiny_model())(tried)
        torch.testing.assert_close(cost(prepare_for_planning(model, PLAIN))(tried), expected, rtol=1e-5, atol=0)
    assert (expected - of_base).norm() > 1e-3 * of_base.norm(), "training changed something"
    found = decided(model)
    monkeypatch.setattr(controller, "prepare_for_planning", lambda given, _: given)
    np.testing.assert_allclose(found, decided(model), rtol=0, atol=1e-5)


@every_adapter
@torch.no_grad()
def test_in_bfloat16_energies_are_those_of_float32_to_rounding(adapter: AdapterConfig) -> None:
    model, tried = trained_model(adapter, torch.bfloat16), actions(50, 2)
    precise, base = copy.deepcopy(model).float(), tiny_model().to(torch.bfloat16)
    exact, of_base = cost(precise)(tried), cost(copy.deepcopy(base).float())(tried)
    rounding = (cost(base)(tried) - of_base).norm() / of_base.norm()  # of a model that was never trained
    error = (cost(prepare_for_planning(model, PLAIN))(tried) - exact).norm() / exact.norm()
    assert error < 2 * rounding < 0.01


@every_adapter
def test_the_given_model_is_not_changed(adapter: AdapterConfig) -> None:
    model = trained_model(adapter, torch.bfloat16).train()
    weights = {name: value.clone() for name, value in model.state_dict().items()}
    trained = [value.requires_grad for value in model.parameters()]
    adaptation, predictor = model.adaptation, model.predictor
    ready = prepare_for_planning(model, PLAIN)
    assert ready.encoder is model.encoder
    assert ready.adaptation is None
    assert not any(part.training for part in ready.modules())
    assert {value.dtype for value in ready.parameters()} == {torch.bfloat16}
    assert model.predictor is predictor
    assert model.predictor.training
    assert model.adaptation is adaptation
    assert [value.requires_grad for value in model.parameters()] == trained
    assert model.state_dict().keys() == weights.keys()
    assert all(torch.equal(value, weights[name]) for name, value in model.state_dict().items())
