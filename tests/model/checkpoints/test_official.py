"""Official checkpoints: the official code's own numbers for both references, and validation of the file."""

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
    facts: dict[str, Any]
    io: dict[str, Tensor]
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


def predictions(reference: Reference) -> tuple[Tensor, Tensor, Tensor]:
    """Return latents, teacher-forced predictions, and the rollout that starts with the first of them."""
    io, model = reference.io, reference.model
    cameras = io.get("extrinsics")
    z = model.encode(io["clips"].transpose(1, 2))
    forced = model.predict(z[:, :-1], io["actions"], io["states"][:, :-1], None if cameras is None else cameras[:, :-1])
    steps = reference.facts["auto_steps"]
    rolled = model.rollout(
        torch.cat([z[:, :1], forced[:, :1]], dim=1),
        io["actions"][:, :steps],
        io["states"][:, :steps],
        None if cameras is None else cameras[:, :steps],
    )
    return z, forced, torch.cat([forced[:, :1], rolled], dim=1)


def test_features_equal_the_official_ones(reference: Reference) -> None:
    frames = reference.io["clips"].transpose(1, 2)
    raw = reference.model.encoder(frames.flatten(0, 1))
    assert_equal_to_rounding(raw.reshape(reference.io["features_raw"].shape), reference.io["features_raw"])
    assert_equal_to_rounding(reference.model.encode(frames).flatten(1, 2), reference.io["features"])


@pytest.mark.parametrize("attention", ["dense", "per_step"])
def test_predictions_losses_and_gradients_equal_the_official_ones(reference: Reference, attention: str) -> None:
    model, io, facts = reference.model, reference.io, reference.facts
    model.set_attention(attention)
    model.predictor.requires_grad_(True)
    model.zero_grad()
    z, forced, rolled = predictions(reference)
    assert_equal_to_rounding(forced.flatten(1, 2), io["z_tf"])
    assert_equal_to_rounding(rolled.flatten(1, 2), io["z_ar"])
    losses = [(part - z[:, 1 : part.shape[1] + 1]).abs().mean() for part in (forced, rolled)]
    assert losses[0].item() == pytest.approx(facts["loss_teacher_forcing"], rel=1e-5)
    assert losses[1].item() == pytest.approx(facts["loss_rollout"], rel=1e-5)
    (losses[0] + losses[1]).backward()
    check_gradients(model, io, facts["predictor_grad_norm"])
    model.predictor.requires_grad_(False)


def check_gradients(model: WorldModel, io: dict[str, Tensor], norm: float) -> None:
    fused: dict[str, dict[int | None, Tensor]] = {}
    for name, value in model.predictor.named_parameters():
        if value.grad is not None:
            official, third = to_official_name(name, "predictor")
            fused.setdefault(official, {})[third] = value.grad
    whole = {n: g[None] if None in g else torch.cat([g[0], g[1], g[2]]) for n, g in fused.items()}
    expected = {name.removeprefix("grad."): value for name, value in io.items() if name.startswith("grad.")}
    assert len(expected) >= 20
    for name, value in expected.items():
        assert_equal_to_rounding(whole[name], value)
    total = torch.stack([gradient.norm() for gradient in whole.values()]).norm().item()
    assert total == pytest.approx(norm, rel=1e-5)


def test_official_weights_go_out_as_they_came_in(reference: Reference) -> None:
    whole = torch.load(reference.path, weights_only=True)
    exported = to_official(reference.model)
    for part in ("encoder", "target_encoder", "predictor"):
        assert exported[part].keys() == whole[part].keys()
        assert all(torch.equal(exported[part][name], value) for name, value in whole[part].items())


TINY_SIZES = ModelSizes(image_size=64, encoder=EncoderSizes(heads=2), predictor=PredictorSizes(heads=4))
Whole = dict[str, Any]


@pytest.fixture
def rewritten(tmp_path: Path) -> Callable[[Callable[[Whole], Any]], Path]:
    """Write the tiny checkpoint, changed by a function of what is in it."""
    return lambda change: rewrite(GOLDEN / "model" / "tiny.pt", change, tmp_path / "changed.pt")


def renamed(weights: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {prefix + name.removeprefix("module."): value for name, value in weights.items()}


@pytest.mark.parametrize("prefix", ["", "module.backbone.", "module._orig_mod.backbone."])
def test_prefixes_in_any_order_and_an_unused_pos_embed_are_no_obstacle(rewritten, prefix: str) -> None:
    def change(whole: Whole) -> None:
        for part in ("encoder", "target_encoder", "predictor"):
            whole[part] = renamed(whole[part], prefix)
        whole["target_encoder"][prefix + "pos_embed"] = torch.zeros(1, 16, 48)

    model = load_official(rewritten(change), TINY_SIZES)
    assert (
        model.predictor_fingerprint() == load_official(GOLDEN / "model" / "tiny.pt", TINY_SIZES).predictor_fingerprint()
    )


# Two encoders in a file.


def trained_encoder(whole: Whole) -> None:
    """As in training, every value of every tensor differs from that of the target a little."""
    generator = torch.Generator().manual_seed(1)
    whole["encoder"] = {
        name: value * (1 + 0.01 * torch.randn(value.shape, generator=generator))
        for name, value in whole["target_encoder"].items()
    }


@pytest.mark.parametrize("change", [trained_encoder, lambda whole: whole.pop("encoder") and None])
def test_the_target_encoder_is_used_whatever_the_other_encoder_is(rewritten, change: Callable[[Whole], None]) -> None:
    expected = load_official(GOLDEN / "model" / "tiny.pt", TINY_SIZES)
    model = load_official(rewritten(change), TINY_SIZES)
    assert model.encoder_fingerprint() == expected.encoder_fingerprint()


def rename_one(whole: Whole) -> None:
    for part in (whole["encoder"], whole["target_encoder"]):
        part["module.blocks.1.norm1.scale"] = part.pop("module.blocks.1.norm1.weight")


def drop_head(whole: Whole) -> None:
    del whole["predictor"]["module.state_encoder.weight"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            rename_one,
            r"encoder: 2 tensors do not match \(missing: blocks.1.norm1.weight; unexpected: blocks.1.norm1.scale\)",
        ),
        (drop_head, r"predictor: 1 tensors do not match \(missing: state_encoder.weight\)"),
        (lambda _: [1, 2], "changed.pt: a list. Expected a checkpoint of V-JEPA"),
        (lambda whole: {"encoder": whole["encoder"]}, r"no predictor \(keys: encoder\)\. Expected both parts"),
        (lambda whole: whole["predictor"], r"no encoder \(keys: module\.\w+\..*Expected both parts.*torch\.save\("),
        (
            lambda whole: whole | {"predictor": renamed(whole["predictor"], "model.")},
            r"no tensor 'action_encoder.weight' in predictor \(its tensors: model\.\w+\.",
        ),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_explained(rewritten, change: Callable[[Whole], Any], message: str) -> None:
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
def test_sizes_that_contradict_the_tensors_are_refused(sizes: ModelSizes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_official(GOLDEN / "model" / "tiny.pt", sizes)


def test_a_truncated_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    whole = (GOLDEN / "model" / "tiny.pt").read_bytes()
    (tmp_path / "cut.pt").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.pt: 0.00 GB, beginning with b.PK.*truncated"):
        load_official(tmp_path / "cut.pt", TINY_SIZES)
    with pytest.raises(InputError, match=r"none\.pt: cannot be read: No such file"):
        load_official(tmp_path / "none.pt", TINY_SIZES)


class Hostile:
    """Runs a command of the system where it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("it-was-executed",)


def in_the_old_format(value: object) -> bytes:
    file = io.BytesIO()
    torch.save(value, file, _use_new_zipfile_serialization=False)
    return file.getvalue()


def in_the_new_format(value: object) -> bytes:
    file = io.BytesIO()
    torch.save(value, file)
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "beginning with b''"),
        (b"version https://git-lfs.github.com/spec/v1\noid", "a git-lfs pointer"),
        (b"<!DOCTYPE html><html>not found</html>", "beginning with b'<!DOCTYPE html>"),
        (pickle.dumps({"encoder": Hostile()}), "that torch cannot read"),
        (in_the_new_format({"encoder": Hostile()}), r"would call posix\.mkdir, which could execute code"),
        (in_the_old_format({"encoder": Hostile()}), "that torch cannot read"),
    ],
)
def test_a_file_that_is_no_checkpoint_shows_how_it_begins_and_is_never_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.pt").write_bytes(content)
    with pytest.raises(InputError, match=said):
        load_official("a.pt", TINY_SIZES)
    assert not Path("it-was-executed").exists()


@pytest.mark.parametrize("value", [np.float64(0.3), Path("here")], ids=["numpy", "path"])
def test_a_file_with_other_objects_prints_the_command_that_saves_its_weights_alone(
    rewritten, tmp_path: Path, value: object
) -> None:
    path = rewritten(lambda whole: whole | {"loss": value}).rename(tmp_path / "it's mine.pt")
    with pytest.raises(InputError, match=r"would call .*If you trust the file, .*: `python -c ") as caught:
        load_official(path, TINY_SIZES)
    python, option, code = shlex.split(str(caught.value).partition("`")[2].rpartition("`")[0])
    assert (python, option) == ("python", "-c")
    exec(code, {})  # noqa: S102 - a user pastes it
    model = load_official(tmp_path / "it's mine.weights.pt", TINY_SIZES)
    expected = load_official(GOLDEN / "model" / "tiny.pt", TINY_SIZES)
    assert model.encoder_fingerprint() == expected.encoder_fingerprint()
    assert model.predictor_fingerprint() == expected.predictor_fingerprint()
