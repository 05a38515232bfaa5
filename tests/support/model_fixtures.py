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
    """Make the model of the fixture `model` once more, or one of another seed or type."""
    return tiny_model


@pytest.fixture
def inputs() -> Inputs:
    return tiny_inputs()


def tiny_model(seed: int = 0, dtype: torch.dtype = torch.float32) -> WorldModel:
    """Return a model of one's own: a copy of what is drawn once for each seed and type."""
    return copy.deepcopy(_drawn(seed, dtype))


def move_trained(model: WorldModel) -> list[Tensor]:
    """Let every trained weight differ from its start; return these weights."""
    generator, trained = torch.Generator().manual_seed(2), [one for one in model.parameters() if one.requires_grad]
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
