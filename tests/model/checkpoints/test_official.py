"""Official checkpoints: equality with the results of the official code, and validation of the file."""

import io
import json
import os
import pickle
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from official_files import assert_equal_to_rounding, rewrite
from paths import GOLDEN
from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints import load_official, to_official, to_official_name
from vjepa2_ac.model.world_model import WorldModel


class Reference(NamedTuple):
    path: Path
    facts: dict[str, Any]  # sizes, losses and gradient norm of the official code
    io: dict[str, Tensor]  # inputs, outputs and gradients of the official code
    sizes: ModelSizes
    model: WorldModel


def sizes_from(config: dict[str, Any]) -> ModelSizes:
    return ModelSizes(
        image_size=config["img"],
        encoder=EncoderSizes(heads=config["enc_heads"]),
        predictor=PredictorSizes(heads=config["p_heads"], use_extrinsics=config.get("extr", False)),
    )


@pytest.fixture(scope="module", params=["tiny", "tiny_extrinsics"])
def reference(request: pytest.FixtureRequest) -> Reference:
    path = GOLDEN / "model" / f"{request.param}.pt"
    facts = json.loads(path.with_suffix(".json").read_text())
    sizes = sizes_from(facts["config"])
    return Reference(path, facts, load_file(path.with_suffix(".io.safetensors")), sizes, load_official(path, sizes))


def predict_as_official(reference: Reference) -> tuple[Tensor, Tensor, Tensor]:
    """Return latents, teacher-forced predictions, and the rollout that starts with the first prediction."""
    io, model = reference.io, reference.model
    cameras = io.get("extrinsics")
    latents = model.encode(io["clips"].transpose(1, 2))
    forced = model.predict(
        latents[:, :-1], io["actions"], io["states"][:, :-1], None if cameras is None else cameras[:, :-1]
    )
    steps = reference.facts["auto_steps"]
    rollout = model.rollout(
        torch.cat([latents[:, :1], forced[:, :1]], dim=1),
        io["actions"][:, :steps],
        io["states"][:, :steps],
        None if cameras is None else cameras[:, :steps],
    )
    return latents, forced, torch.cat([forced[:, :1], rollout], dim=1)


def test_features_equal_the_official_values(reference: Reference) -> None:
    frames = reference.io["clips"].transpose(1, 2)
    raw = reference.model.encoder(frames.flatten(0, 1))
    assert_equal_to_rounding(raw.reshape(reference.io["features_raw"].shape), reference.io["features_raw"])
    assert_equal_to_rounding(reference.model.encode(frames).flatten(1, 2), reference.io["features"])


@pytest.mark.parametrize("attention", ["dense", "per_step"])
def test_predictions_losses_and_gradients_equal_the_official_values(reference: Reference, attention: str) -> None:
    model, io, facts = reference.model, reference.io, reference.facts
    model.set_attention(attention)
    model.predictor.requires_grad_(True)
    model.zero_grad()
    latents, forced, rollout = predict_as_official(reference)
    assert_equal_to_rounding(forced.flatten(1, 2), io["z_tf"])
    assert_equal_to_rounding(rollout.flatten(1, 2), io["z_ar"])
    losses = [(steps - latents[:, 1 : steps.shape[1] + 1]).abs().mean() for steps in (forced, rollout)]
    assert losses[0].item() == pytest.approx(facts["loss_teacher_forcing"], rel=1e-5)
    assert losses[1].item() == pytest.approx(facts["loss_rollout"], rel=1e-5)
    (losses[0] + losses[1]).backward()
    assert_gradients_equal(model, io, facts["predictor_grad_norm"])
    model.predictor.requires_grad_(False)


def assert_gradients_equal(model: WorldModel, io: dict[str, Tensor], norm: float) -> None:
    parts_by_name: dict[str, dict[int | None, Tensor]] = {}
    for name, value in model.predictor.named_parameters():
        if value.grad is not None:
            official, index = to_official_name(name, "predictor")
            parts_by_name.setdefault(official, {})[index] = value.grad
    gradients = {
        name: parts[None] if None in parts else torch.cat([parts[0], parts[1], parts[2]])
        for name, parts in parts_by_name.items()
    }
    expected = {name.removeprefix("grad."): value for name, value in io.items() if name.startswith("grad.")}
    assert len(expected) >= 20
    for name, value in expected.items():
        assert_equal_to_rounding(gradients[name], value)
    total = torch.stack([gradient.norm() for gradient in gradients.values()]).norm().item()
    assert total == pytest.approx(norm, rel=1e-5)


def test_exported_official_checkpoint_equals_the_loaded_file(reference: Reference) -> None:
    content = torch.load(reference.path, weights_only=True)
    exported = to_official(reference.model)
    for part in ("encoder", "target_encoder", "predictor"):
        assert exported[part].keys() == content[part].keys()
        assert all(torch.equal(exported[part][name], value) for name, value in content[part].items())


TINY_SIZES = ModelSizes(image_size=64, encoder=EncoderSizes(heads=2), predictor=PredictorSizes(heads=4))
Content = dict[str, Any]


@pytest.fixture
def rewritten(tmp_path: Path) -> Callable[[Callable[[Content], Any]], Path]:
    """Return a function that writes the tiny checkpoint with changed content."""
    return lambda change: rewrite(GOLDEN / "model" / "tiny.pt", change, tmp_path / "changed.pt")


def with_prefix(weights: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {prefix + name.removeprefix("module."): value for name, value in weights.items()}


@pytest.mark.parametrize("prefix", ["", "module.backbone.", "module._orig_mod.backbone."])
def test_name_prefixes_and_an_unused_pos_embed_are_ignored(rewritten, prefix: str) -> None:
    def change(content: Content) -> None:
        for part in ("encoder", "target_encoder", "predictor"):
            content[part] = with_prefix(content[part], prefix)
        content["target_encoder"][prefix + "pos_embed"] = torch.zeros(1, 16, 48)

    model = load_official(rewritten(change), TINY_SIZES)
    assert (
        model.predictor_fingerprint() == load_official(GOLDEN / "model" / "tiny.pt", TINY_SIZES).predictor_fingerprint()
    )


# Files with two encoders.


def change_trained_encoder(content: Content) -> None:
    """Replace the encoder by one whose values differ slightly from the target encoder's, as after training."""
    generator = torch.Generator().manual_seed(1)
    content["encoder"] = {
        name: value * (1 + 0.01 * torch.randn(value.shape, generator=generator))
        for name, value in content["target_encoder"].items()
    }


@pytest.mark.parametrize("change", [change_trained_encoder, lambda content: content.pop("encoder") and None])
def test_target_encoder_is_used_with_or_without_another_encoder(rewritten, change: Callable[[Content], None]) -> None:
    expected = load_official(GOLDEN / "model" / "tiny.pt", TINY_SIZES)
    model = load_official(rewritten(change), TINY_SIZES)
    assert model.encoder_fingerprint() == expected.encoder_fingerprint()


def rename_norm(content: Content) -> None:
    for part in (content["encoder"], content["target_encoder"]):
        part["module.blocks.1.norm1.scale"] = part.pop("module.blocks.1.norm1.weight")


def remove_state_encoder(content: Content) -> None:
    del content["predictor"]["module.state_encoder.weight"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            rename_norm,
            r"encoder: 2 tensors do not match \(missing: blocks.1.norm1.weight; unexpected: blocks.1.norm1.scale\)",
        ),
        (remove_state_encoder, r"predictor: 1 tensors do not match \(missing: state_encoder.weight\)"),
        (lambda _: [1, 2], "changed.pt: a list. Expected a checkpoint of V-JEPA"),
        (lambda content: {"encoder": content["encoder"]}, r"no predictor \(keys: encoder\)\. Expected both parts"),
        (lambda content: content["predictor"], r"no encoder \(keys: module\.\w+\..*Expected both parts.*torch\.save\("),
        (
            lambda content: content | {"predictor": with_prefix(content["predictor"], "model.")},
            r"no tensor 'action_encoder.weight' in predictor \(its tensors: model\.\w+\.",
        ),
    ],
)
def test_checkpoint_with_wrong_tensors_raises_with_their_names(
    rewritten, change: Callable[[Content], Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        load_official(rewritten(change), TINY_SIZES)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        (TINY_SIZES.model_copy(update={"encoder": EncoderSizes(heads=22)}), "encoder.width 48 is not a multiple of"),
        (
            TINY_SIZES.model_copy(update={"predictor": PredictorSizes(heads=4, depth=12)}),
            "predictor.depth 3, and model.sizes has 12",
        ),
    ],
)
def test_sizes_that_contradict_the_tensors_raise(sizes: ModelSizes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_official(GOLDEN / "model" / "tiny.pt", sizes)


def test_truncated_or_missing_file_raises(tmp_path: Path) -> None:
    content = (GOLDEN / "model" / "tiny.pt").read_bytes()
    (tmp_path / "cut.pt").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"cut\.pt: 0.00 GB, beginning with b.PK.*truncated"):
        load_official(tmp_path / "cut.pt", TINY_SIZES)
    with pytest.raises(InputError, match=r"none\.pt: cannot be read: No such file"):
        load_official(tmp_path / "none.pt", TINY_SIZES)


class Hostile:
    """An object that executes a system call when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("executed",)


def save_in_old_format(value: object) -> bytes:
    file = io.BytesIO()
    torch.save(value, file, _use_new_zipfile_serialization=False)
    return file.getvalue()


def save_in_new_format(value: object) -> bytes:
    file = io.BytesIO()
    torch.save(value, file)
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "beginning with b''"),
        (b"version https://git-lfs.github.com/spec/v1\noid", "a git-lfs pointer"),
        (b"<!DOCTYPE html><html>not found</html>", "beginning with b'<!DOCTYPE html>"),
        (pickle.dumps({"encoder": Hostile()}), "that torch cannot read"),
        (save_in_new_format({"encoder": Hostile()}), r"would call posix\.mkdir, which could execute code"),
        (save_in_old_format({"encoder": Hostile()}), "that torch cannot read"),
    ],
)
def test_invalid_file_raises_with_its_first_bytes_and_is_not_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.pt").write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_official("a.pt", TINY_SIZES)
    assert not Path("executed").exists()


@pytest.mark.parametrize("value", [np.float64(0.3), Path("here")], ids=["numpy", "path"])
def test_file_with_other_objects_raises_with_the_command_that_extracts_its_weights(
    rewritten, tmp_path: Path, value: object
) -> None:
    path = rewritten(lambda content: content | {"loss": value}).rename(tmp_path / "it's mine.pt")
    with pytest.raises(InputError, match=r"would call .*If you trust the file, .*: `python -c ") as caught:
        load_official(path, TINY_SIZES)
    python, option, code = shlex.split(str(caught.value).partition("`")[2].rpartition("`")[0])
    assert (python, option) == ("python", "-c")
    exec(code, {})  # noqa: S102 - the user would run this command
    model = load_official(tmp_path / "it's mine.weights.pt", TINY_SIZES)
    expected = load_official(GOLDEN / "model" / "tiny.pt", TINY_SIZES)
    assert model.encoder_fingerprint() == expected.encoder_fingerprint()
    assert model.predictor_fingerprint() == expected.predictor_fingerprint()
