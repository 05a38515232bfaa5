"""The world model, its encoder, and the initial weights of a predictor."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.world_model import WorldModel

Fresh = Callable[..., WorldModel]


def test_seed_determines_the_weights(fresh: Fresh) -> None:
    torch.manual_seed(5)
    model = fresh(seed=3)
    torch.manual_seed(6)
    assert model.predictor_fingerprint() == fresh(seed=3).predictor_fingerprint() != fresh(4).predictor_fingerprint()
    assert model.encoder_fingerprint() == fresh(seed=3).encoder_fingerprint() != fresh(4).encoder_fingerprint()


def test_context_longer_than_the_actions_raises(model: WorldModel, inputs) -> None:
    with pytest.raises(ValueError, match="2 actions for a context of 3 latents"):
        model.rollout(inputs.latents[:, :3], inputs.actions[:, :2], inputs.states[:, :2])


def test_saved_model_gives_equal_outputs_after_loading(model: WorldModel, tmp_path: Path, inputs) -> None:
    model.save_pretrained(tmp_path / "model")
    loaded = WorldModel.from_pretrained(tmp_path / "model")
    assert loaded.sizes == model.sizes
    assert not any(value.requires_grad for value in loaded.parameters())
    assert torch.equal(loaded.encode(inputs.frames), model.encode(inputs.frames))
    expected = model.predict(inputs.latents, inputs.actions, inputs.states)
    assert torch.equal(loaded.predict(inputs.latents, inputs.actions, inputs.states), expected)


def break_sizes(folder: Path) -> None:
    card = json.loads((folder / "config.json").read_text())
    card["sizes"]["predictor"]["depth"] = 3
    (folder / "config.json").write_text(json.dumps(card))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (shutil.rmtree, "config.json: cannot be read: No such file or directory. Expected a folder written by"),
        (
            lambda folder: (folder / "config.json").write_text('{"model_type": "vjepa2"}'),
            "config.json: not the config of a world model",
        ),
        (break_sizes, r"model.safetensors: 16 tensors do not match \(missing: blocks.2.attn.k.bias"),
        (
            lambda folder: os.truncate(folder / "encoder.safetensors", 1000),
            "encoder.safetensors: not a complete safetensors file",
        ),
    ],
)
def test_incomplete_model_folder_raises_with_its_path(
    model: WorldModel, tmp_path: Path, damage: Callable[[Path], None], message: str
) -> None:
    model.save_pretrained(tmp_path / "model")
    damage(tmp_path / "model")
    with pytest.raises(InputError, match=message):
        WorldModel.from_pretrained(tmp_path / "model")


def test_model_without_its_encoder_predicts_as_before_and_keeps_the_fingerprint(
    model: WorldModel, fresh: Fresh, inputs, tmp_path: Path
) -> None:
    model.remove_encoder()
    model.remove_encoder()  # a second call has no effect
    original = fresh(seed=0)
    assert model.encoder_fingerprint() == original.encoder_fingerprint()
    assert sum(p.numel() for p in model.parameters()) == sum(p.numel() for p in original.predictor.parameters())
    assert model.to("cpu").device == torch.device("cpu")
    arguments = inputs.latents, inputs.actions, inputs.states
    assert torch.equal(model.predict(*arguments), original.predict(*arguments))
    for use_encoder in (lambda: model.encode(inputs.frames), lambda: model.save_pretrained(tmp_path / "model")):
        with pytest.raises(ValueError, match="the encoder was removed"):
            use_encoder()


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"predictor": {"depth": 10**9}}, "sizes: predictor.depth: Input should be less than or equal to 512"),
        ({"encoder": {"width": 16_384, "depth": 512, "heads": 128}}, "weights, more than"),
        ({"image_size": 8_192, "patch_size": 1}, "tokens per frame, more than 65,536"),
        ({"encoder": {"mlp_ratio": 1e-9}}, "makes the MLP narrower than 1"),
        ({"encoder": {"mlp_ratio": "4"}}, "sizes: encoder.mlp_ratio: Input should be a valid number"),
        (None, "sizes: Input should be"),
    ],
)
def test_folder_with_absurd_sizes_raises_before_memory_is_allocated(
    model: WorldModel, tmp_path: Path, sizes: dict[str, Any] | None, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model.save_pretrained(tmp_path)
    card = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(card | {"sizes": sizes}))
    monkeypatch.setattr(WorldModel, "empty", None)
    with pytest.raises(InputError) as caught:
        WorldModel.from_pretrained(tmp_path)
    assert message in str(caught.value)
    assert caught.value.where == f"{tmp_path / 'config.json'}: sizes"


def test_encoder_stays_frozen_and_in_eval_mode_during_training(model: WorldModel, inputs) -> None:
    model.train()
    assert model.predictor.training
    assert not any(module.training for module in model.encoder.modules())
    assert not any(value.requires_grad for value in model.encoder.parameters())
    assert not model.encode(inputs.frames.requires_grad_()).requires_grad


def make_sizes(width: int) -> ModelSizes:
    return ModelSizes(
        image_size=32,
        encoder=EncoderSizes(width=48, depth=1, heads=2, mlp_ratio=2.0),
        predictor=PredictorSizes(width=width, depth=2, heads=2),
    )


def measure_similarity_to_input(model: WorldModel) -> Tensor:
    latents = torch.nn.functional.layer_norm(
        torch.randn(2, 3, 4, 48, generator=torch.Generator().manual_seed(0)), (48,)
    )
    zeros = torch.zeros(2, 3, 7)
    return torch.cosine_similarity(model.predict(latents, zeros, zeros), latents, dim=-1).mean()


@pytest.mark.parametrize(("width", "min_similarity"), [(48, 0.95), (64, 0.95), (32, 0.7)])
def test_initialisation_near_persistence_copies_the_input(width: int, min_similarity: float) -> None:
    near_persistence = WorldModel.random(make_sizes(width), seed=0, near_persistence=True)
    released_recipe = WorldModel.random(make_sizes(width), seed=0)
    assert measure_similarity_to_input(near_persistence) > min_similarity
    assert measure_similarity_to_input(released_recipe) < 0.3
