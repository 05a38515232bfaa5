"""Compiled blocks: the same results as plain ones, and few compilations, not one per step, layer or length."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch._dynamo.utils import counters

from model_fixtures import move_trained
from tracing import tracing
from vjepa2_ac.config import AdapterConfig, ModelSizes
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training.step import prediction_losses

pytestmark = [pytest.mark.usefixtures("traced"), *tracing]


def graphs() -> int:
    return int(counters["stats"]["unique_graphs"])


def adapted(sizes: ModelSizes, **changes: Any) -> WorldModel:
    """Return a model of two blocks whose adapter does something."""
    model = WorldModel.random(sizes, seed=0)
    add_adapter(model, AdapterConfig(**{"rank": 4, "alpha": 8.0, "dropout": 0.0} | changes), seed=0)
    move_trained(model)
    return model.train()  # type: ignore[return-value]


def clips(inputs: Any, count: int = 2) -> LatentBatch:
    given = (inputs.latents[:count], inputs.states[:count], inputs.actions[:count, :-1])
    return LatentBatch(*given, None, ("a",) * count, (0,) * count)


def loss_and_gradients(model: WorldModel, batch: LatentBatch, *, compiled: bool, rollout: int = 2) -> list[Tensor]:
    model.set_compiled("with gradients" if compiled else "never")
    model.zero_grad()
    torch.manual_seed(0)
    loss = sum(prediction_losses(model, batch, rollout))
    loss.backward()
    return [loss.detach(), *(value.grad.clone() for value in model.parameters() if value.grad is not None)]


def assert_same(found: list[Tensor], expected: list[Tensor], tolerance: float = 1e-5) -> None:
    assert len(found) == len(expected) > 1
    for one, other in zip(found, expected, strict=True):
        assert (one - other).norm() <= tolerance * other.norm()


def test_compiled_steps_equal_uncompiled_ones_without_recompilation(sizes: ModelSizes, inputs) -> None:
    model, batch = adapted(sizes), clips(inputs)
    names = list(model.state_dict())
    expected = loss_and_gradients(model, batch, compiled=False)
    assert_same(loss_and_gradients(model, batch, compiled=True), expected)
    # Two halves of: a first block, later ones, and one step of the rollout. Not one for each block.
    assert graphs() == 2 * 3
    assert not counters["graph_break"]
    model.set_gradient_checkpointing(True)
    expected = loss_and_gradients(model, batch, compiled=False, rollout=3)
    assert_same(loss_and_gradients(model, batch, compiled=True, rollout=3), expected)
    assert graphs() == 2 * 3
    assert list(model.state_dict()) == names
