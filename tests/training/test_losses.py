"""The losses equal the official ones and their definitions; the rollout reuses the first step of teacher forcing."""

import json
from dataclasses import replace
from typing import Any

import pytest
import torch
from pydantic import ValidationError
from safetensors.torch import load_file
from torch import Tensor
from torch.nn.functional import layer_norm, smooth_l1_loss

from model_fixtures import move_trained
from paths import GOLDEN
from vjepa2_ac.config import AdapterConfig, EncoderSizes, ModelSizes, PredictorSizes, TrainingConfig
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model import predictor
from vjepa2_ac.model.checkpoints import load_official
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training.step import Objective, prediction_losses

FRAMES = 7
LORA = AdapterConfig(rank=4, alpha=8.0, dropout=0.0)
NONE = AdapterConfig(kind="none")


def official(name: str) -> tuple[WorldModel, LatentBatch, dict[str, Any]]:
    expected = json.loads((GOLDEN / "model" / f"{name}.json").read_text())
    tensors, config = load_file(GOLDEN / "model" / f"{name}.io.safetensors"), expected["config"]
    sizes = {
        "image_size": config["img"], "encoder": {"heads": config["enc_heads"]},
        "predictor": {"heads": config["p_heads"], "use_extrinsics": bool(config.get("extr"))},
    }  # fmt: skip
    latents = tensors["features"].unflatten(1, (expected["frames"], -1))
    cameras = tensors.get("extrinsics") if config.get("extr") else None
    batch = LatentBatch(latents, tensors["states"], tensors["actions"], cameras, ("a", "b"), (0, 0))
    return load_official(GOLDEN / "model" / f"{name}.pt", ModelSizes.model_validate(sizes)), batch, expected


@pytest.mark.parametrize("name", ["tiny", "tiny_extrinsics"])
def test_losses_equal_the_official_code(name: str) -> None:
    model, batch, expected = official(name)
    forced, rollout = Objective(model, TrainingConfig(rollout_steps=expected["auto_steps"]))(batch)
    assert forced.item() == pytest.approx(expected["loss_teacher_forcing"], rel=1e-5)
    assert rollout.item() == pytest.approx(expected["loss_rollout"], rel=1e-5)
    assert forced.item() + rollout.item() == pytest.approx(expected["loss"], rel=1e-5)


def test_rollout_longer_than_the_clip_raises() -> None:
    model, batch, _ = official("tiny")
    with pytest.raises(ValueError, match="needs 17 frames"):
        prediction_losses(model, batch, 16)


@pytest.mark.parametrize("keys", [{"loss": "l2"}, {"loss": {"name": "smooth_l1", "options": {"beta": 0.25}}}])
def test_other_distances_equal_pytorch(keys: dict[str, Any]) -> None:
    model, batch, _ = official("tiny")
    with torch.no_grad():
        forced = model.predict(batch.latents[:, :-1], batch.actions, batch.states[:, :-1])
        loss, _ = Objective(model, TrainingConfig.model_validate(keys))(batch)
    true = batch.latents[:, 1:]
    expected = smooth_l1_loss(forced, true, beta=0.25) if keys["loss"] != "l2" else (forced - true).square().mean()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"loss": "huber"}, "no loss has this name"),
        ({"loss": {"name": "l1", "options": {"beta": 0.5}}}, "no options of its own"),
    ],
)
def test_invalid_loss_options_raise(keys: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        TrainingConfig.model_validate(keys)


def trained_model(adapter: AdapterConfig, *, extrinsics: bool = False, checkpointing: bool = False) -> WorldModel:
    """Return a model whose adapter has an effect."""
    sizes = ModelSizes(
        image_size=48,
        encoder=EncoderSizes(width=24, depth=1, heads=2, mlp_ratio=2.0),
        predictor=PredictorSizes(width=36, depth=3, heads=3, mlp_ratio=2.0, use_extrinsics=extrinsics),
    )
    model = WorldModel.random(sizes, seed=0)
    add_adapter(model, adapter, seed=0)
    move_trained(model)
    model.set_gradient_checkpointing(checkpointing)
    return model.train()  # type: ignore[return-value]


def clips(*, extrinsics: bool = False) -> LatentBatch:
    generator = torch.Generator().manual_seed(1)
    shapes = [(2, FRAMES, 9, 24), (2, FRAMES, 7), (2, FRAMES - 1, 7), (2, FRAMES, 6)]
    latents, states, actions, cameras = (torch.randn(*shape, generator=generator) for shape in shapes)
    return LatentBatch(latents, states, actions, cameras if extrinsics else None, ("a", "b"), (0, 0))


def plain_losses(model: WorldModel, batch: LatentBatch, steps: int) -> tuple[Tensor, Tensor]:
    """Compute the losses without cached keys and values: each prediction is computed from the first frame on."""

    def predict(latents: Tensor, time: int) -> Tensor:
        cameras = None if batch.extrinsics is None else batch.extrinsics[:, :time]
        return model.predict(latents, batch.actions[:, :time], batch.states[:, :time], cameras)

    latents_so_far = batch.latents[:, :1]
    for time in range(1, steps + 1):
        latents_so_far = torch.cat([latents_so_far, predict(latents_so_far, time)[:, -1:]], dim=1)
    forced = predict(batch.latents[:, :-1], FRAMES - 1)
    pairs = ((forced, batch.latents[:, 1:]), (latents_so_far[:, 1:], batch.latents[:, 1 : steps + 1]))
    return tuple((predicted - true).abs().mean() for predicted, true in pairs)  # type: ignore[return-value]


def with_gradients(model: WorldModel, losses: tuple[Tensor, Tensor]) -> list[Tensor]:
    trained = [value for value in model.parameters() if value.requires_grad]
    return [*losses, *torch.autograd.grad(losses[0] + 2.0 * losses[1], trained)]


@pytest.mark.parametrize("steps", [2, 6])
@pytest.mark.parametrize(
    ("adapter", "checkpointing", "extrinsics"), [(LORA, False, True), (LORA, True, False), (NONE, True, True)], ids=str
)
def test_losses_and_gradients_equal_those_without_key_value_cache(
    monkeypatch: pytest.MonkeyPatch, steps: int, adapter: AdapterConfig, checkpointing: bool, extrinsics: bool
) -> None:
    # Float64 throughout: otherwise predictions are normalised in float32.
    monkeypatch.setattr(predictor, "normalise_latents", lambda latents: layer_norm(latents, latents.shape[-1:]))
    model = trained_model(adapter, extrinsics=extrinsics, checkpointing=checkpointing).double()
    batch = clips(extrinsics=extrinsics)
    tensors = {name: value.double() for name, value in vars(batch).items() if isinstance(value, Tensor)}
    batch = replace(batch, **tensors)
    distance = lambda predicted, true: (predicted - true).abs()  # noqa: E731
    actual = with_gradients(model, prediction_losses(model, batch, steps, distance))
    expected = with_gradients(model, plain_losses(model, batch, steps))
    for value, reference in zip(actual, expected, strict=True):
        assert reference.any()
        assert (value - reference).norm() <= 1e-12 * reference.norm()  # 2e-14 was measured


def test_dropout_mask_of_teacher_forcing_does_not_depend_on_the_rollout() -> None:
    model = trained_model(LORA.model_copy(update={"dropout": 0.5}))
    torch.manual_seed(0)
    first, _ = prediction_losses(model, clips(), 1)
    torch.manual_seed(0)
    forced, _ = prediction_losses(model, clips(), 3)
    assert torch.equal(first, forced)
