"""The rollout reuses the first step of teacher forcing: cheaper, with the same losses and gradients."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import layer_norm

from vjepa2_ac.config import AdapterConfig, EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.adapter.lora import add_adapter
from vjepa2_ac.model.network import predictor_network as dynamics
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.training.loss import prediction_losses

FRAMES = 7
LORA = AdapterConfig(rank=4, alpha=8.0, dropout=0.0)
NONE = AdapterConfig(kind="none")


def trained_model(
    adapter: AdapterConfig = LORA, *, extrinsics: bool = False, checkpointing: bool = False
) -> WorldModel:
    """Return a model whose adapter does something."""
    sizes = ModelSizes(
        image_size=48,
        encoder=EncoderSizes(width=24, depth=1, heads=2, mlp_ratio=2.0),
        predictor=PredictorSizes(width=36, depth=3, heads=3, mlp_ratio=2.0, use_extrinsics=extrinsics),
    )
    model = WorldModel.random(sizes, seed=0)
    add_adapter(model, adapter, seed=0)
    generator = torch.Generator().manual_seed(2)
    for value in trained(model):
        value.data += 0.05 * torch.randn(value.shape, generator=generator)
    model.set_gradient_checkpointing(checkpointing)
    return model.train()  # type: ignore[return-value]


def trained(model: WorldModel) -> list[Tensor]:
    return [value for value in model.parameters() if value.requires_grad]


def clips(*, extrinsics: bool = False) -> LatentBatch:
    draw = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    generator = torch.Generator().manual_seed(1)
    cameras = draw(2, FRAMES, 6) if extrinsics else None
    return LatentBatch(draw(2, FRAMES, 9, 24), draw(2, FRAMES, 7), draw(2, FRAMES - 1, 7), cameras, ("a", "b"), (0, 0))


def plain_losses(model: WorldModel, batch: LatentBatch, steps: int) -> tuple[Tensor, Tensor]:
    """Compute the rollout from the first frame on, and everything again for each prediction."""

    def predict(latents: Tensor, time: int) -> Tensor:
        cameras = None if batch.extrinsics is None else batch.extrinsics[:, :time]
        return model.predict(latents, batch.actions[:, :time], batch.states[:, :time], cameras)

    seen = batch.latents[:, :1]
    for time in range(1, steps + 1):
        seen = torch.cat([seen, predict(seen, time)[:, -1:]], dim=1)
    forced = predict(batch.latents[:, :-1], FRAMES - 1)
    pairs = ((forced, batch.latents[:, 1:]), (seen[:, 1:], batch.latents[:, 1 : steps + 1]))
    return tuple((predicted - true).abs().mean() for predicted, true in pairs)  # type: ignore[return-value]


def in_float64(batch: LatentBatch) -> LatentBatch:
    return replace(batch, **{name: value.double() for name, value in vars(batch).items() if isinstance(value, Tensor)})


def with_gradients(model: WorldModel, parts: Any) -> list[Tensor]:
    forced, rollout = parts
    used = [value for value in trained(model) if value.requires_grad]
    return [forced, rollout, *torch.autograd.grad(forced + 2.0 * rollout, used)]


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Float64 throughout: predictions are normalised in float32 otherwise, whatever the weights."""
    monkeypatch.setattr(dynamics, "normalise_latents", lambda features: layer_norm(features, features.shape[-1:]))


def distance(predicted: Tensor, true: Tensor) -> Tensor:
    return (predicted - true).abs()


@pytest.mark.usefixtures("exact")
@pytest.mark.parametrize("steps", [2, 3, 6])
@pytest.mark.parametrize("adapter", [LORA, NONE], ids=["lora", "none"])
@pytest.mark.parametrize("checkpointing", [False, True])
@pytest.mark.parametrize("extrinsics", [False, True])
def test_losses_and_gradients_equal_those_of_computing_everything_again(
    steps: int, adapter: AdapterConfig, checkpointing: bool, extrinsics: bool
) -> None:
    model = trained_model(adapter, extrinsics=extrinsics, checkpointing=checkpointing).double()
    batch = in_float64(clips(extrinsics=extrinsics))
    found = with_gradients(model, prediction_losses(model, batch, steps, distance))
    expected = with_gradients(model, plain_losses(model, batch, steps))
    for one, other in zip(found, expected, strict=True):
        assert other.any()
        assert one.dtype == other.dtype == torch.float64
        assert (one - other).norm() <= 1e-12 * other.norm()  # 2e-14 was seen


def test_each_further_prediction_costs_one_step() -> None:
    model = trained_model()
    block = model.base_predictor.blocks[0]
    lengths: list[int] = []
    block.norm1.register_forward_hook(lambda _module, _inputs, output: lengths.append(output.shape[1] // 11))
    prediction_losses(model, clips(), 4)
    assert lengths == [FRAMES - 1, 1, 1, 1]


def test_dropout_leaves_out_the_same_of_the_first_step_in_both_parts() -> None:
    model = trained_model(LORA.model_copy(update={"dropout": 0.5}))
    batch = clips()
    torch.manual_seed(0)
    first, _ = prediction_losses(model, batch, 1)
    torch.manual_seed(0)
    forced, _ = prediction_losses(model, batch, 3)
    assert torch.equal(first, forced)  # teacher forcing draws first, whatever follows
