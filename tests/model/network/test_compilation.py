"""Compiled blocks give the results of uncompiled blocks, and are not compiled again for each step, layer or length."""

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


def count_graphs() -> int:
    return int(counters["stats"]["unique_graphs"])


def make_adapted_model(sizes: ModelSizes) -> WorldModel:
    """Return a model of two blocks with an adapter that changes the predictions."""
    model = WorldModel.random(sizes, seed=0)
    add_adapter(model, AdapterConfig(rank=4, alpha=8.0, dropout=0.0), seed=0)
    move_trained(model)
    return model.train()  # type: ignore[return-value]


def make_batch(inputs: Any) -> LatentBatch:
    return LatentBatch(inputs.latents[:2], inputs.states[:2], inputs.actions[:2, :-1], None, ("a", "a"), (0, 0))


def loss_and_gradients(model: WorldModel, batch: LatentBatch, *, is_compiled: bool, rollout: int = 2) -> list[Tensor]:
    model.set_compiled("with gradients" if is_compiled else "never")
    model.zero_grad()
    torch.manual_seed(0)
    loss = sum(prediction_losses(model, batch, rollout))
    loss.backward()
    return [loss.detach(), *(value.grad.clone() for value in model.parameters() if value.grad is not None)]


def assert_near(actual: list[Tensor], expected: list[Tensor]) -> None:
    assert len(actual) == len(expected) > 1
    for value, expected_value in zip(actual, expected, strict=True):
        assert (value - expected_value).norm() <= 1e-5 * expected_value.norm()


def test_compiled_steps_equal_uncompiled_steps_without_recompilation(sizes: ModelSizes, inputs) -> None:
    model, batch = make_adapted_model(sizes), make_batch(inputs)
    names = list(model.state_dict())
    expected = loss_and_gradients(model, batch, is_compiled=False)
    assert_near(loss_and_gradients(model, batch, is_compiled=True), expected)
    # Both halves of a block are compiled three times: for the first block, for later blocks, and for a rollout step.
    assert count_graphs() == 2 * 3
    assert not counters["graph_break"]
    model.set_gradient_checkpointing(True)
    expected = loss_and_gradients(model, batch, is_compiled=False, rollout=3)
    assert_near(loss_and_gradients(model, batch, is_compiled=True, rollout=3), expected)
    assert count_graphs() == 2 * 3
    assert list(model.state_dict()) == names
