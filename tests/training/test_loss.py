"""The loss equals the official one; other distances and weights equal their definitions."""

import json
from dataclasses import replace

import pytest
import torch
from pydantic import ValidationError
from safetensors.torch import load_file

from paths import GOLDEN
from vjepa2_ac.config import ModelSizes, TrainingConfig
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.checkpoints.official import load_official
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.training.loss import Objective, action_contrast_loss, others_actions, prediction_losses


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
    forced, rollout = Objective(model, TrainingConfig(rollout_steps=expected["auto_steps"]))(batch)
    assert (forced.item(), rollout.item()) == (losses.teacher_forcing.item(), losses.rollout.item())


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
    losses = prediction_losses(model, two, 1)
    assert torch.equal(losses.rollout, losses.teacher_forcing)


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
    beta, total = training.smooth_l1_beta, 0.0
    for difference in (predicted - true).abs().flatten().tolist():
        if training.loss == "l1":
            total += difference
        elif training.loss == "l2":
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
        {"loss": "smooth_l1", "smooth_l1_beta": 0.25},
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
        ({"loss": "huber"}, "'l1', 'l2' or 'smooth_l1'"),
        ({"smooth_l1_beta": 0.5}, "belongs to loss smooth_l1, not l1"),
        ({"action_contrast": {"weight": 1.0}, "batch_size": 1}, "needs a batch_size of at least 2"),
        ({"action_contrast": {"margin": 0.0}}, "greater than 0"),
    ],
)
def test_a_loss_that_makes_no_sense_is_refused(knobs: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        TrainingConfig.model_validate(knobs)


# ---- action contrast ----


@pytest.mark.parametrize("loss", ["l1", "l2"])
def test_the_action_contrast_equals_a_plain_computation(loss: str) -> None:
    model, batch = reference()
    training = TrainingConfig.model_validate({"loss": loss, "action_contrast": {"margin": 0.3, "weight": 2.0}})
    with torch.no_grad():
        found = Objective(model, training)(batch)
        missing = []
        for clip, other in ((0, 1), (1, 0)):
            latents, states = batch.latents[clip : clip + 1], batch.states[clip : clip + 1, :-1]
            right, wrong = (
                plain_distance(
                    training, model.predict(latents[:, :-1], batch.actions[k : k + 1], states), latents[:, 1:]
                )
                for k in (clip, other)
            )
            missing.append(max(0.0, right - wrong + 0.3 * plain_distance(training, latents[:, :-1], latents[:, 1:])))
        plain = Objective(model, TrainingConfig.model_validate({"loss": loss}))(batch)
    assert sum(missing) > 0
    assert found[2].item() == pytest.approx(2.0 * sum(missing) / 2, rel=1e-5)
    assert [one.item() for one in found[:2]] == [one.item() for one in plain]  # to the last bit
    assert len(plain) == 2


def errors(*clips: float) -> torch.Tensor:
    return torch.tensor(clips).reshape(-1, 1, 1, 1).expand(-1, 3, 4, 5).clone().requires_grad_()


def test_a_clip_beyond_the_margin_asks_for_nothing_and_one_within_it_moves_both_predictions() -> None:
    right, wrong, copied = errors(0.2, 0.5), errors(0.9, 0.55), errors(1.0, 1.0).detach()
    loss = action_contrast_loss(right, wrong, copied, margin=0.1)
    assert loss.item() == pytest.approx((0.0 + 0.05) / 2)
    loss.backward()
    sums = [one.grad.sum((1, 2, 3)).tolist() for one in (right, wrong)]
    assert sums == [[0.0, pytest.approx(0.5)], [0.0, pytest.approx(-0.5)]]


def test_the_margin_is_a_share_of_what_changes_so_units_cancel_and_a_still_clip_asks_for_nothing() -> None:
    loss = action_contrast_loss(errors(0.5, 0.0), errors(0.5, 0.0), errors(1.0, 0.0), margin=0.1)
    assert loss.item() == pytest.approx(0.05)
    tenfold = action_contrast_loss(errors(5.0, 0.0), errors(5.0, 0.0), errors(10.0, 0.0), margin=0.1)
    assert tenfold.item() == pytest.approx(10 * loss.item())  # as every other part of the loss grows


def test_clips_with_the_same_actions_have_no_gradient() -> None:
    model, batch = reference()
    model.predictor.requires_grad_(True)
    same = replace(batch, actions=batch.actions[:1].expand(2, -1, -1).clone())
    *_, contrast = Objective(model, TrainingConfig.model_validate({"action_contrast": {"weight": 1.0}}))(same)
    assert contrast.item() > 0
    contrast.backward()
    gradients = [one.grad for one in model.parameters() if one.grad is not None]
    assert gradients
    assert max(one.abs().max().item() for one in gradients) < 1e-7


def test_wrong_actions_are_those_of_the_clip_before_or_of_one_that_is_alone_its_own_backwards() -> None:
    actions = torch.arange(12.0).reshape(3, 2, 2)
    assert others_actions(actions).tolist() == [actions[k].tolist() for k in (2, 0, 1)]
    assert others_actions(actions[:1]).tolist() == [[[2.0, 3.0], [0.0, 1.0]]]
