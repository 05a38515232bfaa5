"""Tiny world models, and inputs that fit them."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import pytest
import torch
from torch import Tensor

from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.model.world_model import WorldModel

SIZES = ModelSizes(
    image_size=48,
    encoder=EncoderSizes(width=24, depth=2, heads=2, mlp_ratio=2.0),
    predictor=PredictorSizes(width=36, depth=2, heads=3, mlp_ratio=2.0),
)


@dataclass(frozen=True)
class Inputs:
    frames: Tensor
    latents: Tensor
    actions: Tensor
    states: Tensor


@pytest.fixture
def sizes() -> ModelSizes:
    return SIZES


@pytest.fixture
def model() -> WorldModel:
    return tiny_model()


@pytest.fixture
def fresh() -> Callable[..., WorldModel]:
    """Return a function that returns a new copy of the fixture `model`, or a model with another seed or data type."""
    return tiny_model


@pytest.fixture
def inputs() -> Inputs:
    return tiny_inputs()


def tiny_model(seed: int = 0, dtype: torch.dtype = torch.float32) -> WorldModel:
    """Return a copy of a random model, which is drawn only once for each seed and data type."""
    return copy.deepcopy(_drawn(seed, dtype))


def move_trained(model: WorldModel) -> list[Tensor]:
    """Change every trained weight, and return the trained weights."""
    generator = torch.Generator().manual_seed(2)
    trained = [value for value in model.parameters() if value.requires_grad]
    for value in trained:
        value.data += 0.05 * torch.randn(value.shape, generator=generator)
    return trained


@cache
def _drawn(seed: int, dtype: torch.dtype) -> WorldModel:
    return WorldModel.random(SIZES, seed=seed, dtype=dtype)


def tiny_inputs() -> Inputs:
    generator = torch.Generator().manual_seed(1)
    draw = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    return Inputs(draw(2, 4, 3, 48, 48), draw(2, 4, 9, 24), draw(2, 4, 7), draw(2, 4, 7))
