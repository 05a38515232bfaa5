"""The loss is the official one."""

import json

import pytest
import torch
from safetensors.torch import load_file

from paths import GOLDEN
from vjepa2_ac.config import ModelSizes
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.weights import load_official
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
    losses = prediction_losses(model, batch, expected["auto_steps"])
    assert losses.teacher_forcing.item() == pytest.approx(expected["loss_teacher_forcing"], rel=1e-5)
    assert losses.rollout.item() == pytest.approx(expected["loss_rollout"], rel=1e-5)
    assert losses.total.item() == pytest.approx(expected["loss"], rel=1e-5)
    forced, rollout = Objective(model, expected["auto_steps"])(batch)
    assert (forced + rollout).item() == losses.total.item()


def sizes_of(config: dict[str, int]) -> ModelSizes:
    """Only what a checkpoint cannot say of itself."""
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
    losses = prediction_losses(model, two, 1)
    assert torch.equal(losses.rollout, losses.teacher_forcing)


def test_a_rollout_longer_than_the_clip_is_refused() -> None:
    expected = json.loads((GOLDEN / "model" / "tiny.json").read_text())
    model = load_official(GOLDEN / "model" / "tiny.pt", sizes_of(expected["config"]))
    batch = LatentBatch(torch.zeros(1, 3, 16, 48), torch.zeros(1, 3, 7), torch.zeros(1, 2, 7), None, ("a",), (0,))
    with pytest.raises(ValueError, match="needs 4 frames"):
        prediction_losses(model, batch, 3)
