"""Encoders of both families: the official code's own numbers, every form of file, and what is never silently wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from paths import GOLDEN
from vjepa2_ac.config import ModelConfig
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel

FILES = GOLDEN / "encoders"
V2, V21 = FILES / "vjepa2_pretrained.pt", FILES / "vjepa2_1_distilled.pt"
HEADS = {V2: 3, V21: 4}


class Golden(NamedTuple):
    path: Path
    facts: dict[str, Any]
    io: dict[str, Tensor]
    is_newer: bool


@pytest.fixture(scope="module", params=[V2, V21], ids=["2", "2.1"])
def golden(request: pytest.FixtureRequest) -> Golden:
    path: Path = request.param
    facts = json.loads(path.with_suffix(".json").read_text())
    return Golden(path, facts, load_file(path.with_suffix(".io.safetensors")), path == V21)


def model_of(path: Path | str, size: int = 96, **encoder: Any) -> WorldModel:
    """Return a model with the encoder of a file, and a small fresh predictor."""
    known = {"heads": HEADS[path]} if path in HEADS else {}
    predictor = {"width": 24, "depth": 1, "heads": 2}
    config = {
        "encoder": {"path": str(path), **known, **encoder},
        "random": {"image_size": size, "predictor": predictor},
        "dtype": "float32",
    }
    return load_base(ModelConfig.model_validate(config), seed=0)


def assert_equal_to_rounding(found: Tensor, expected: Tensor) -> None:
    """Within 1e-5 of the largest value: fp32 rounding of sums in another order."""
    assert found.shape == expected.shape
    assert (found - expected).abs().max() <= 1e-5 * expected.abs().max()


def test_features_and_latents_equal_the_official_ones_at_every_size(golden: Golden) -> None:
    for size in map(int, golden.facts["sizes_px"]):
        model, io = model_of(golden.path, size), golden.io
        assert_equal_to_rounding(model.present_encoder(io[f"frames.{size}"]), io[f"tubelet.{size}"])
        assert_equal_to_rounding(model.encode(io[f"frames.{size}"][None])[0], io[f"latents.{size}"])


def test_the_image_path_equals_the_official_one_at_every_size() -> None:
    io = load_file(V21.with_suffix(".io.safetensors"))
    for size in (96, 80, 256):
        model = model_of(V21, size, frame="image")
        assert_equal_to_rounding(model.present_encoder(io[f"frames.{size}"]), io[f"image.{size}"])


@pytest.mark.parametrize("frame", ["tubelet", "image"])
def test_a_video_equals_the_official_one(golden: Golden, frame: str) -> None:
    size = golden.facts["video_px"]
    if frame == "image" and not golden.is_newer:
        return
    video = golden.io[f"video.{size}"].transpose(1, 2)
    found = model_of(golden.path, size, frame=frame).present_encoder.encode_videos(video)
    assert_equal_to_rounding(found, golden.io[f"video_features.{size}"])


def test_another_key_is_another_encoder(golden: Golden) -> None:
    name = next(name for name in golden.io if name.startswith("other_key_tubelet."))
    size = int(name.rpartition(".")[2])
    model = model_of(golden.path, size, key="encoder")
    assert_equal_to_rounding(model.present_encoder(golden.io[f"frames.{size}"]), golden.io[name])
    usual = model_of(golden.path, size)
    assert model.encoder_fingerprint() != usual.encoder_fingerprint()
    assert usual.encoder_origin is not None
    assert usual.encoder_origin.key == golden.facts["checkpoint"]["encoder_key"]


def test_norms_of_lower_levels_are_where_they_belong() -> None:
    """No output of ours depends on them; an export must not mix them up."""
    io, encoder = load_file(V21.with_suffix(".io.safetensors")), model_of(V21).present_encoder
    levels: list[Tensor] = []
    hooks = [
        encoder.vit.layer[index].register_forward_hook(
            lambda _, __, out: levels.append(out[0] if isinstance(out, tuple) else out)
        )
        for index in (2, 5, 8, 11)
    ]
    name = next(name for name in io if name.startswith("hierarchical."))
    encoder(io[name.replace("hierarchical", "frames")])
    for hook in hooks:
        hook.remove()
    norms = [*encoder.vit.level_norms, encoder.vit.layernorm]
    found = torch.cat([norm(level) for norm, level in zip(norms, levels, strict=True)], dim=-1)
    assert_equal_to_rounding(found, io[name])
