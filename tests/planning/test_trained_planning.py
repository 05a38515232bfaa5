"""Merged and compiled models plan like the trained model, which stays unchanged."""

import copy

import numpy as np
import pytest
import torch
from torch._dynamo.utils import counters

from decisions import STATE
from tiny_models import actions, cost, tiny_model
from tracing import tracing
from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.config.planning import EnergyConfig, PlanningConfig
from vjepa2_ac.config.section import Component
from vjepa2_ac.errors import InputError
from vjepa2_ac.model import compilation
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
    """Return a tiny model whose trainable weights were changed."""
    model = tiny_model().to(dtype)
    add_adapter(model, adapter, seed=0)
    generator = torch.Generator().manual_seed(2)
    for value in model.parameters():
        if value.requires_grad:
            value.data += 0.02 * torch.randn(value.shape, generator=generator)
    return model.eval()


def decide(model: WorldModel, config: PlanningConfig = PLAIN) -> list[np.ndarray]:
    images = np.random.default_rng(0).integers(0, 256, (3, 48, 48, 3), dtype=np.uint8)
    planning_controller = Controller(model, config)
    planning_controller.reset(images[0])
    return [planning_controller.act(image, STATE) for image in images[1:]]


@every_adapter
def test_merged_model_decides_like_the_trained_model(adapter: AdapterConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    model, samples = trained_model(adapter), actions(20, 2)
    with torch.no_grad():
        expected, base_energies = cost(model)(samples), cost(tiny_model())(samples)
        torch.testing.assert_close(cost(prepare_for_planning(model, PLAIN))(samples), expected, rtol=1e-5, atol=0)
    assert (expected - base_energies).norm() > 1e-3 * base_energies.norm(), "the trained weights change the energies"
    actual = decide(model)
    monkeypatch.setattr(controller, "prepare_for_planning", lambda world_model, _: world_model)
    np.testing.assert_allclose(actual, decide(model), rtol=0, atol=1e-5)


@every_adapter
@torch.no_grad()
def test_bfloat16_energies_equal_float32_up_to_rounding(adapter: AdapterConfig) -> None:
    model, samples = trained_model(adapter, torch.bfloat16), actions(50, 2)
    precise, base = copy.deepcopy(model).float(), tiny_model().to(torch.bfloat16)
    exact, base_energies = cost(precise)(samples), cost(copy.deepcopy(base).float())(samples)
    rounding = (cost(base)(samples) - base_energies).norm() / base_energies.norm()  # for the base model
    error = (cost(prepare_for_planning(model, PLAIN))(samples) - exact).norm() / exact.norm()
    assert error < 2 * rounding < 0.01


@every_adapter
def test_controller_leaves_the_model_unchanged(adapter: AdapterConfig) -> None:
    model = trained_model(adapter, torch.bfloat16).train()
    weights = {name: value.clone() for name, value in model.state_dict().items()}
    trained = [value.requires_grad for value in model.parameters()]
    adaptation, predictor = model.adaptation, model.predictor
    prepared = prepare_for_planning(model, PLAIN)
    assert prepared.encoder is model.encoder
    assert prepared.adaptation is None
    assert not any(part.training for part in prepared.modules())
    assert {value.dtype for value in prepared.parameters()} == {torch.bfloat16}
    assert model.predictor is predictor
    assert model.predictor.training
    assert model.adaptation is adaptation
    assert [value.requires_grad for value in model.parameters()] == trained
    assert model.state_dict().keys() == weights.keys()
    assert all(torch.equal(value, weights[name]) for name, value in model.state_dict().items())


pytestmark = tracing

IN_PARTS = PLAIN.model_copy(update={"samples": 11, "horizon": 3, "energy": EnergyConfig(samples_at_once=4)})
COMPILED = IN_PARTS.model_copy(update={"compile": "blocks"})


@pytest.fixture(autouse=True)
def _with_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "describe_missing_compiler", lambda _: None)


@pytest.mark.usefixtures("traced")
@pytest.mark.parametrize("adapted", [False, True])
@pytest.mark.parametrize("planner", ["cem", "gradient"])
def test_compiled_plans_equal_uncompiled_plans(adapted: bool, planner: str) -> None:
    model, planned = tiny_model(adapted=adapted), {"planner": Component(planner)}
    expected = decide(model, IN_PARTS.model_copy(update=planned))
    assert not counters["stats"]
    actual = decide(model, COMPILED.model_copy(update=planned))
    assert counters["stats"]["unique_graphs"]
    assert not counters["graph_break"]
    np.testing.assert_allclose(actual, expected, atol=1e-6)


def test_missing_compiler_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_model()
    monkeypatch.setattr(compilation, "describe_missing_compiler", lambda kind: f"no compiler for {kind}")
    with pytest.raises(InputError, match=r"no compiler for cpu.*planning.compile=off"):
        Controller(tiny_model(), COMPILED)
    Controller(model, IN_PARTS)
