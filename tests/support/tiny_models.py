"""A tiny world model, a scene of it, and goals."""

import torch
from torch import Tensor

from vjepa2_ac.config import AdapterConfig, EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.config.planning import EnergyConfig
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.energy import Goal, Scene, WorldModelCost

TOKENS, DIM = 9, 24


def tiny_model(*, adapted: bool = False, extrinsics: bool = False, states: bool = True, depth: int = 2) -> WorldModel:
    """Return a random model that is sensitive to actions; optionally with an adapter that changes the predictions."""
    sizes = ModelSizes(
        image_size=48,
        encoder=EncoderSizes(width=DIM, depth=1, heads=2, mlp_ratio=2.0),
        predictor=PredictorSizes(
            width=36, depth=depth, heads=3, mlp_ratio=2.0, use_extrinsics=extrinsics, use_states=states
        ),
    )
    model = WorldModel.random(sizes, seed=0)
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        model.base_predictor.action_encoder.weight.mul_(40)
        if adapted:
            add_adapter(model, AdapterConfig(rank=4, alpha=8.0, dropout=0.1), seed=0)
            for name, value in model.named_parameters():
                if "lora_" in name:
                    value.add_(0.05 * torch.randn(value.shape, generator=generator))
    return model.eval()


def vector_model(width: int, *, states: bool = True) -> WorldModel:
    """Return a random model whose states and actions have `width` numbers."""
    sizes = tiny_model(states=states).sizes
    predictor = sizes.predictor.model_copy(update={"action_dim": width, "state_dim": width if states else 7})
    return WorldModel.random(sizes.model_copy(update={"predictor": predictor}), seed=0).eval()


def draw(*shape: int, seed: int = 1) -> Tensor:
    """Return normally distributed random numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def scene(*, extrinsics: bool = False) -> Scene:
    """Return a random frame and state at a decision."""
    return Scene(draw(TOKENS, DIM), draw(7, seed=2) * 0.3, draw(6, seed=4) if extrinsics else None)


def actions(samples: int, steps: int, seed: int = 5) -> Tensor:
    """Return actions of a few cm."""
    return 0.05 * draw(samples, steps, 7, seed=seed)


def goal(goals: int = 1, **options: object) -> Goal:
    """Return goals with random latents."""
    return Goal(torch.nn.functional.layer_norm(draw(goals, TOKENS, DIM, seed=6), (DIM,)), **options)  # type: ignore[arg-type]


def cost(model: WorldModel, **settings: object) -> WorldModelCost:
    """Return the cost of plans from `scene` to `goal`."""
    return WorldModelCost(model, scene(), goal(), EnergyConfig(**settings))  # type: ignore[arg-type]
