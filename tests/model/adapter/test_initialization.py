"""Initial values of a fresh predictor."""

import pytest
import torch
from torch import Tensor

from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.model.network.world_model import WorldModel


def sizes(width: int) -> ModelSizes:
    return ModelSizes(
        image_size=32,
        encoder=EncoderSizes(width=48, depth=1, heads=2, mlp_ratio=2.0),
        predictor=PredictorSizes(width=width, depth=2, heads=2),
    )


def likeness_to_the_input(model: WorldModel) -> Tensor:
    latents = torch.nn.functional.layer_norm(
        torch.randn(2, 3, 4, 48, generator=torch.Generator().manual_seed(0)), (48,)
    )
    zeros = torch.zeros(2, 3, 7)
    return torch.cosine_similarity(model.predict(latents, zeros, zeros), latents, dim=-1).mean()


@pytest.mark.parametrize(("width", "least"), [(48, 0.95), (64, 0.95), (32, 0.7)])
def test_a_predictor_that_starts_at_persistence_begins_close_to_copying(width: int, least: float) -> None:
    copying = WorldModel.random(sizes(width), seed=0, at_persistence=True)
    released = WorldModel.random(sizes(width), seed=0)
    assert likeness_to_the_input(copying) > least
    assert likeness_to_the_input(released) < 0.3


def test_the_start_does_not_depend_on_the_number_of_threads() -> None:
    prints = set()
    for threads in (1, 2):
        torch.set_num_threads(threads)
        prints.add(WorldModel.random(sizes(48), seed=0, at_persistence=True).predictor_fingerprint())
    assert len(prints) == 1
