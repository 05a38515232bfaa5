"""The loss equals the official one; other distances and weights equal their definitions."""

import json

import pytest
import torch
from pydantic import ValidationError
from safetensors.torch import load_file

from paths import GOLDEN
from vjepa2_ac.config import ModelSizes, TrainingConfig
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.checkpoints import load_official
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.training.loss import Objective, prediction_losses


@pytest.mark.parametrize("name", ["tiny", "tiny_extrinsics"])
def test_losses_equal_the_official_code(name: str) -> None:
    expected = json.loads((GOLDEN / "model" / f"{name}.json").read_text())
    tensors = load_file(GOLDEN / "model" / f"{name}.io.safetensors")
    model = load_official(GOLDEN / "model" / f"{name}.pt", sizes_of(expected["config"]))
    latents = tensors["features"].unflatten(1, (expected["frames"], -1))
    batch = LatentBatch(latents, tensors["states"], tensors["actions"], tensors.get("extrinsics"), ("a", "b"), (0, 0))
    if not model.sizes.predictor.use_extrinsics:
        batch = LatentBatch(latents, tensors["states"], tensors["actions"], None, ("a", "b"), (0, 0))
    forced, rollout = Objective(model, TrainingConfig(rollout_steps=expected["auto_steps"]))(batch)
    assert forced.item() == pytest.approx(expected["loss_teacher_forcing"], rel=1e-5)
    assert rollout.item() == pytest.approx(expected["loss_rollout"], rel=1e-5)
    assert forced.item() + rollout.item() == pytest.approx(expected["loss"], rel=1e-5)


def sizes_of(config: dict[str, int]) -> ModelSizes:
    """Settings that are not in the checkpoint."""
    return ModelSizes.model_validate(
        {
            "image_size": config["img"],
            "encoder": {"heads": config["enc_heads"]},
            "predictor": {"heads": config["p_heads"], "use_extrinsics": bool(config.get("extr"))},
        }
    )


def test_a_rollout_of_one_step_is_the_first_teacher_forced_step() -> None:
    expected = json.loads((GOLDEN / "model" / "tiny.json").read_text())
    tensors = load_file(GOLDEN / "model" / "tiny.io.safetensors")
    model = load_official(GOLDEN / "model" / "tiny.pt", sizes_of(expected["config"]))
    latents = tensors["features"].unflatten(1, (expected["frames"], -1))
    two = LatentBatch(latents[:, :2], tensors["states"][:, :2], tensors["actions"][:, :1], None, ("a", "b"), (0, 0))
    assert torch.equal(*prediction_losses(model, two, 1))


def test_a_rollout_longer_than_the_clip_is_refused() -> None:
    expected = json.loads((GOLDEN / "model" / "tiny.json").read_text())
    model = load_official(GOLDEN / "model" / "tiny.pt", sizes_of(expected["config"]))
    batch = LatentBatch(torch.zeros(1, 3, 16, 48), torch.zeros(1, 3, 7), torch.zeros(1, 2, 7), None, ("a",), (0,))
    with pytest.raises(ValueError, match="needs 4 frames"):
        prediction_losses(model, batch, 3)


def reference() -> tuple[WorldModel, LatentBatch]:
    expected = json.loads((GOLDEN / "model" / "tiny.json").read_text())
    tensors = load_file(GOLDEN / "model" / "tiny.io.safetensors")
    latents = tensors["features"].unflatten(1, (expected["frames"], -1))
    batch = LatentBatch(latents, tensors["states"], tensors["actions"], None, ("a", "b"), (0, 0))
    return load_official(GOLDEN / "model" / "tiny.pt", sizes_of(expected["config"])), batch


def plain_distance(training: TrainingConfig, predicted: torch.Tensor, true: torch.Tensor) -> float:
    """One element after the other, as the definitions are written."""
    loss, total = training.loss.name, 0.0
    beta = training.loss.options.get("beta", 1.0)
    for difference in (predicted - true).abs().flatten().tolist():
        if loss == "l1":
            total += difference
        elif loss == "l2":
            total += difference**2
        else:
            total += difference**2 / (2 * beta) if difference < beta else difference - beta / 2
    return total / predicted.numel()


@pytest.mark.parametrize(
    "knobs",
    [
        {"loss": "l1"},
        {"loss": "l2"},
        {"loss": "smooth_l1"},
        {"loss": {"name": "smooth_l1", "options": {"beta": 0.25}}},
        {"rollout_steps": 3, "teacher_forcing_weight": 0.5, "rollout_weight": 2.0},
        {"loss": "l2", "rollout_steps": 1, "teacher_forcing_weight": 0.0},
        {"rollout_weight": 0.0},
    ],
)
def test_every_distance_and_weight_equals_a_plain_computation(knobs: dict[str, object]) -> None:
    model, batch = reference()
    training = TrainingConfig.model_validate(knobs)
    frames, steps = batch.latents.shape[1], training.rollout_steps
    with torch.no_grad():
        forced = model.predict(batch.latents[:, :-1], batch.actions, batch.states[:, :-1])
        rolled = batch.latents[:, :1]
        for time in range(1, steps + 1):
            following = model.predict(rolled, batch.actions[:, :time], batch.states[:, :time])[:, -1:]
            rolled = torch.cat([rolled, following], dim=1)
        found = Objective(model, training)(batch)
    assert frames > steps
    teacher = plain_distance(training, forced, batch.latents[:, 1:])
    rollout = plain_distance(training, rolled[:, 1:], batch.latents[:, 1 : steps + 1])
    assert found[0].item() == pytest.approx(teacher * training.teacher_forcing_weight, rel=1e-5)
    assert found[1].item() == pytest.approx(rollout * training.rollout_weight, rel=1e-5)


@pytest.mark.parametrize(
    ("knobs", "complaint"),
    [
        ({"teacher_forcing_weight": 0.0, "rollout_weight": 0.0}, "both 0"),
        ({"rollout_weight": -1.0}, "greater than or equal to 0"),
        ({"loss": "huber"}, "no loss of this name"),
        ({"loss": {"name": "l1", "options": {"beta": 0.5}}}, "no options of its own"),
    ],
)
def test_a_loss_that_makes_no_sense_is_refused(knobs: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        TrainingConfig.model_validate(knobs)
