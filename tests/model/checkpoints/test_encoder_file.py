"""Encoders of both families: equality with the official code, all file formats, and errors for wrong files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from hub import serve_hub
from official_files import assert_equal_to_rounding, rewrite
from paths import GOLDEN
from vjepa2_ac.config import EncoderSizes, ModelConfig, ModelSizes
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError
from vjepa2_ac.model.checkpoints import load_base, load_official, to_official
from vjepa2_ac.model.model_files import EncoderOrigin, find_base
from vjepa2_ac.model.world_model import WorldModel

FILES = GOLDEN / "encoders"
V2, V21 = FILES / "vjepa2_pretrained.pt", FILES / "vjepa2_1_distilled.pt"
NUM_HEADS = {V2: 3, V21: 4}


class Golden(NamedTuple):
    path: Path
    facts: dict[str, Any]  # how the file was written, and the checked sizes
    io: dict[str, Tensor]  # inputs and outputs of the official code
    is_v21: bool


@pytest.fixture(scope="module", params=[V2, V21], ids=["2", "2.1"])
def golden(request: pytest.FixtureRequest) -> Golden:
    path: Path = request.param
    facts = json.loads(path.with_suffix(".json").read_text())
    return Golden(path, facts, load_file(path.with_suffix(".io.safetensors")), path == V21)


def model_of(path: Path | str, size: int = 96, dtype: str = "float32", **encoder: Any) -> WorldModel:
    """Return a model with the encoder in a file, and a small new predictor."""
    heads = {"heads": NUM_HEADS[path]} if path in NUM_HEADS else {}
    config = {
        "base": "random",
        "encoder": {"path": str(path), **heads, **encoder},
        "sizes": {"image_size": size, "predictor": {"width": 24, "depth": 1, "heads": 2}},
        "dtype": dtype,
    }
    return load_base(ModelConfig.model_validate(config), seed=0)


def test_features_and_latents_equal_the_official_values_at_every_size(golden: Golden) -> None:
    for size in map(int, golden.facts["sizes_px"]):
        model, io = model_of(golden.path, size), golden.io
        assert_equal_to_rounding(model.loaded_encoder(io[f"frames.{size}"]), io[f"tubelet.{size}"])
        assert_equal_to_rounding(model.encode(io[f"frames.{size}"][None])[0], io[f"latents.{size}"])


def test_image_path_equals_the_official_values_at_every_size() -> None:
    io = load_file(V21.with_suffix(".io.safetensors"))
    for size in (96, 80, 256):
        model = model_of(V21, size, frame="image")
        assert_equal_to_rounding(model.loaded_encoder(io[f"frames.{size}"]), io[f"image.{size}"])


def test_another_key_loads_another_encoder(golden: Golden) -> None:
    name = next(name for name in golden.io if name.startswith("other_key_tubelet."))
    size = int(name.rpartition(".")[2])
    model = model_of(golden.path, size, key="encoder")
    assert_equal_to_rounding(model.loaded_encoder(golden.io[f"frames.{size}"]), golden.io[name])
    default = model_of(golden.path, size)
    assert model.encoder_fingerprint() != default.encoder_fingerprint()
    assert default.encoder_origin is not None
    assert default.encoder_origin.key == golden.facts["checkpoint"]["encoder_key"]


# All other file formats give the same latents.


def rename_with_predictor(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return weights by transformers' names, with a tensor of the masked predictor, which must be ignored."""
    return rename_encoder(weights) | {"predictor.embeddings.mask_tokens": torch.zeros(2, 3)}


def rename_encoder(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.replace("vit.", "encoder.", 1): value for name, value in weights.items()}


CARD = {
    "model_type": "vjepa2", "hidden_size": 48, "num_hidden_layers": 6, "num_attention_heads": 3, "mlp_ratio": 4.0,
    "crop_size": 96, "patch_size": 16, "tubelet_size": 2, "hidden_act": "gelu", "qkv_bias": True,
    "layer_norm_eps": 1e-06, "frames_per_clip": 64, "architectures": ["VJEPA2Model"],
}  # fmt: skip
Rename = Callable[[dict[str, Tensor]], dict[str, Tensor]]


def write_transformers(folder: Path, rename: Rename = rename_with_predictor, shards: int = 1, **card: Any) -> Path:
    """Write the reference encoder of V-JEPA 2 in the format of transformers."""
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(CARD | card))
    weights = {name: value.clone() for name, value in rename(dict(model_of(V2).encoder.state_dict())).items()}
    if shards == 1:
        save_file(weights, folder / "model.safetensors", metadata={"format": "pt"})
        return folder
    for shard in range(shards):
        tensors = dict(list(weights.items())[shard::shards])
        save_file(tensors, folder / f"model-{shard + 1:05}-of-{shards:05}.safetensors", metadata={"format": "pt"})
    return folder


@pytest.mark.parametrize("shards", [1, 3])
def test_transformers_folder_loads_the_same_encoder(tmp_path: Path, shards: int) -> None:
    model, original = model_of(write_transformers(tmp_path / "hf", shards=shards)), model_of(V2)
    assert model.sizes == original.sizes
    assert model.encoder_fingerprint() == original.encoder_fingerprint()
    frames = load_file(V2.with_suffix(".io.safetensors"))["frames.96"][None]
    assert torch.equal(model.encode(frames), original.encode(frames))


def test_transformers_model_class_gives_equal_features(tmp_path: Path) -> None:
    """This confirms that the folder written by these tests has the format of transformers."""
    from transformers import VJEPA2Model

    folder = write_transformers(tmp_path / "hf", rename_encoder)
    transformers_model = VJEPA2Model.from_pretrained(folder).eval()
    frames = load_file(V2.with_suffix(".io.safetensors"))["frames.96"]
    with torch.no_grad():
        expected = transformers_model(frames[:, None].expand(-1, 2, -1, -1, -1), skip_predictor=True).last_hidden_state
    assert_equal_to_rounding(model_of(folder).loaded_encoder(frames), expected)


def test_encoder_on_the_hub_loads_from_the_cache_without_a_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    with serve_hub({"facebook/tiny": write_transformers(tmp_path / "hf")}):
        model = model_of("hf://facebook/tiny")
        assert model.encoder_fingerprint() == model_of(V2).encoder_fingerprint()
        assert str(model.encoder_origin) == "hf://facebook/tiny"
        for wrong, message in (
            ("facebook/none", "does not exist"),
            ("facebook/tiny@v9", "model or revision does not exist"),
        ):
            with pytest.raises(RefusedError, match=message):
                model_of(f"hf://{wrong}")
    cached = model_of("hf://facebook/tiny")  # from the cache
    assert cached.encoder_fingerprint() == model.encoder_fingerprint()
    with pytest.raises(UnreachableError, match="the Hub cannot be reached"):
        model_of("hf://facebook/other")


@pytest.mark.parametrize("frame", ["tubelet", "image"])
def test_saved_folder_and_exported_official_file_load_the_same_encoder(
    golden: Golden, tmp_path: Path, frame: str
) -> None:
    if frame == "image" and not golden.is_v21:
        return
    model = model_of(golden.path, frame=frame)
    model.save_pretrained(tmp_path / "model")
    loaded = WorldModel.from_pretrained(tmp_path / "model")
    assert loaded.sizes == model.sizes
    assert loaded.encoder_origin == model.encoder_origin
    assert loaded.encoder_fingerprint() == model.encoder_fingerprint()
    with_new_predictor = model_of(tmp_path / "model", frame=frame)
    assert with_new_predictor.encoder_fingerprint() == model.encoder_fingerprint()
    frames = golden.io["frames.96"][None]
    assert torch.equal(with_new_predictor.encode(frames), model.encode(frames))
    torch.save(to_official(model), tmp_path / "official.pt")
    official = load_official(tmp_path / "official.pt", model.sizes)
    assert official.sizes == model.sizes
    for name, value in official.state_dict().items():
        assert torch.equal(value, model.state_dict()[name]), name


def test_exported_official_file_has_metas_name_for_every_tensor(golden: Golden) -> None:
    content = torch.load(golden.path, weights_only=True)
    official = content[golden.facts["checkpoint"]["encoder_key"]]
    exported = to_official(model_of(golden.path))["encoder"]
    assert {name.removeprefix("module.") for name in exported} == {
        name.removeprefix("module.backbone.") for name in official
    }
    for name, value in exported.items():
        assert torch.equal(value, official[name.replace("module.", "module.backbone.", 1)]), name


# Wrong files and configs raise, with a fix.


def remove_last_norm(content: dict[str, Any]) -> None:
    for kind in ("weight", "bias"):
        del content["ema_encoder"][f"module.backbone.norms_block.3.{kind}"]


def add_tensor(content: dict[str, Any]) -> None:
    content["ema_encoder"]["module.backbone.cls_token"] = torch.zeros(1, 1, 64)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (remove_last_norm, r"missing: norms_block\.3\.bias.*Get the original"),
        (add_tensor, r"ema_encoder: 1 tensors do not match \(unexpected: cls_token\)"),
        (lambda _: {"encoder": {"a": 1}}, "no weights under 'encoder'"),
        (lambda _: {"encoder": {"a": torch.zeros(1)}}, "no tensor 'patch_embed.proj.weight' in encoder"),
    ],
)
def test_incomplete_encoder_file_raises(tmp_path: Path, change: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        model_of(rewrite(V21, change, tmp_path / "changed.pt"), heads=NUM_HEADS[V21])


@pytest.mark.parametrize(
    ("path", "encoder", "message"),
    [
        (V21, {"heads": None}, "width 64, .*its number of heads is unknown.*Set model.encoder.heads"),
        (V21, {"heads": 5}, "64 is not a multiple of encoder.heads 5"),
        (V2, {"frame": "image"}, "image needs V-JEPA 2.1"),
        (V2, {"key": "ema_encoder"}, r"no ema_encoder .*Set model.encoder.key"),
    ],
)
def test_encoder_config_that_contradicts_the_file_raises(path: Path, encoder: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        model_of(path, **encoder)


@pytest.mark.parametrize(
    ("card", "message"),
    [
        ({"model_type": "vit"}, "model_type: Input should be 'vjepa2'"),
        ({"num_attention_heads": 4}, "48"),
        ({"hidden_size": 96}, "do not match"),
        ({"tubelet_size": 4}, "tubelet_size"),
        ({"hidden_size": 10**9}, "hidden_size"),
    ],
)
def test_transformers_config_that_contradicts_the_tensors_raises(
    tmp_path: Path, card: dict[str, Any], message: str
) -> None:
    folder = write_transformers(tmp_path / "hf", **card)
    if card == {"num_attention_heads": 4}:  # the tensors do not contradict this number; only the fingerprint differs
        assert model_of(folder).encoder_fingerprint() != model_of(V2).encoder_fingerprint()
        return
    with pytest.raises(InputError, match=message):
        model_of(folder)


def test_pretraining_checkpoint_as_base_raises() -> None:
    with pytest.raises(InputError, match=r"no action input.*set model\.encoder\.path to this file"):
        load_base(ModelConfig(base=str(V21)), seed=0)


def test_encoders_with_equal_tensors_but_different_latents_have_different_fingerprints() -> None:
    original = model_of(V21).encoder_fingerprint()
    assert model_of(V21, frame="image").encoder_fingerprint() != original
    assert model_of(V21, heads=2).encoder_fingerprint() != original
    published = WorldModel.empty(ModelSizes(encoder=EncoderSizes(width=1024, depth=1, heads=16)))
    published.encoder_origin = EncoderOrigin("vitl.pt")
    assert not published.encoder_properties, "a published number of heads must not change the fingerprint"
    without_origin = WorldModel.empty(ModelSizes(encoder=EncoderSizes(width=48, depth=1, heads=3)))
    assert not without_origin.encoder_properties, "the fingerprint of older models must not change"


def test_encoder_of_a_model_has_the_same_fingerprint_with_a_new_predictor() -> None:
    """The decoder and the caches of the model can therefore be used with the new predictor."""
    model = WorldModel.from_pretrained(find_base("builtin:sim-tiny"))
    assert model_of("builtin:sim-tiny").encoder_fingerprint() == model.encoder_fingerprint()


# Features of an earlier block.


def test_layer_option_returns_the_features_after_that_block(golden: Golden, tmp_path: Path) -> None:
    full_model, frames = model_of(golden.path), golden.io["frames.96"]
    depth, outputs = full_model.sizes.encoder.depth, list[Tensor]()
    layer = 2 * depth // 3
    hook = full_model.loaded_encoder.vit.layer[layer - 1].register_forward_hook(
        lambda _, __, out: outputs.append(out[0] if isinstance(out, tuple) else out)
    )
    full_model.encode(frames[None])
    hook.remove()
    expected = torch.nn.functional.layer_norm(outputs[0], outputs[0].shape[-1:], eps=1e-6)
    truncated = model_of(golden.path, layer=layer)
    assert len(truncated.loaded_encoder.vit.layer) == truncated.sizes.encoder.depth == layer < depth
    assert_equal_to_rounding(truncated.encode(frames[None])[0], expected)
    assert truncated.encoder_fingerprint() != full_model.encoder_fingerprint()
    truncated.save_pretrained(tmp_path / "cut")
    loaded = load_base(ModelConfig(base=str(tmp_path / "cut"), dtype="float32"), seed=0)
    torch.testing.assert_close(loaded.encode(frames[None]), truncated.encode(frames[None]), rtol=0, atol=0)
    from_folder = model_of(tmp_path / "cut", layer=layer - 1)
    torch.testing.assert_close(
        from_folder.encode(frames[None]), model_of(golden.path, layer=layer - 1).encode(frames[None]), rtol=0, atol=0
    )
    last = model_of(golden.path, layer=depth)
    torch.testing.assert_close(last.encode(frames[None]), full_model.encode(frames[None]), rtol=0, atol=0)
    with pytest.raises(InputError, match=rf"model.encoder.layer: {depth + 1}, .* at most {depth}"):
        model_of(golden.path, layer=depth + 1)
