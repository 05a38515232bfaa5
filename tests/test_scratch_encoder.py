"""From scratch on a pretrained encoder, record, encode, train, export."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from paths import GOLDEN
from vjepa2_ac.cli import main
from vjepa2_ac.config import ModelConfig
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.runs.subject import load_subject

ENCODER = {"path": str(GOLDEN / "encoders" / "vjepa2_1_distilled.pt"), "heads": 4}
MODEL = {
    "base": "random",
    "encoder": ENCODER,
    "sizes": {"image_size": 96, "predictor": {"width": 64, "depth": 2, "heads": 4}},
    "dtype": "float32",
}


def write_config(folder: Path, name: str, model: dict[str, object] = MODEL, **more: object) -> str:
    values = {
        "run_dir": str(folder / name),
        "data": {
            "path": str(folder / "data"), "frames": 3, "stride": 4, "validation_share": 0.3, "test_share": 0.3,
            "workers": 0, "cache": "require", "cache_dir": str(folder / "latents"),
        },
        "model": model,
        "adapter": {"kind": "none"},
        "training": {
            "steps": 4, "batch_size": 2, "accumulation": 1, "warmup_steps": 0, "precision": "fp32", "device": "cpu",
            "allow_weak_base": True,
        },
        "validation": {"every": 4, "clips": 4, "batch_size": 2, "ranking_samples": 4},
        "checkpoint": {"every": 1},
        **more,
    }  # fmt: skip
    (folder / f"{name}.yaml").write_text(yaml.safe_dump(values))
    return str(folder / f"{name}.yaml")


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulated data, their latents, and a run that was not disturbed."""
    folder = tmp_path_factory.mktemp("workshop")
    assert main(["simulate", "record", str(folder / "data"), "--domain", "B", "--episodes", "10", "--steps", "14"]) == 0
    config = write_config(folder, "whole")
    assert main(["encode", config]) == 0
    assert main(["train", config, "--check"]) == 0
    assert main(["train", config]) == 0
    return folder


def test_an_export_is_a_base_with_its_encoder(workshop: Path, tmp_path: Path) -> None:
    assert main(["export", str(workshop / "whole"), str(tmp_path / "merged")]) == 0
    assert main(["export", str(workshop / "whole"), str(tmp_path / "official.pt"), "--to", "official"]) == 0
    run = load_subject(workshop / "whole").world_model.eval()
    sizes = {"image_size": 96, "encoder": {"heads": 4}, "predictor": {"width": 64, "heads": 4}}
    rng = np.random.default_rng(0)
    frames = torch.from_numpy(rng.normal(size=(1, 2, 3, 96, 96))).float()
    numbers = torch.from_numpy(rng.normal(size=(1, 2, 7))).float() * 0.1
    latents = run.encode(frames)
    expected = run.predict(latents, numbers, numbers)
    for base in (tmp_path / "merged", tmp_path / "official.pt"):
        told = {"base": str(base), "dtype": "float32"} | ({"sizes": sizes} if base.suffix else {})
        model = load_base(ModelConfig.model_validate(told), seed=0)
        assert torch.equal(model.encode(frames), latents)
        assert torch.allclose(model.predict(latents, numbers, numbers), expected, atol=1e-6)
    card = json.loads((tmp_path / "merged" / "config.json").read_text())
    origin = {"file": "vjepa2_1_distilled.pt", "key": "ema_encoder", "licence": "", "heads_are_told": True}
    assert card["encoder_origin"] == origin
    lora = write_config(workshop, "lora", {"base": str(tmp_path / "merged"), "dtype": "float32"}, adapter={"rank": 2})
    assert main(["train", lora, "training.steps=1"]) == 0  # on the same latents: the cache is required
    assert main(["export", str(workshop / "lora"), str(tmp_path / "hub"), "--to", "hub"]) == 0
    words = "V-JEPA 2.1, 12 blocks of 64, 4 heads, each frame as a tubelet; from vjepa2_1_distilled.pt, ema_encoder"
    assert words in (tmp_path / "hub" / "README.md").read_text()
    assert json.loads((tmp_path / "hub" / "vjepa2_ac.json").read_text())["encoder_in_words"] == words


def test_latents_of_another_frame_path_are_not_taken(workshop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = write_config(workshop, "image", {**MODEL, "encoder": {**ENCODER, "frame": "image"}})
    assert main(["train", config]) == 2
    error = capsys.readouterr().err
    assert "no latent cache of this model" in error
    assert "encoder.frame: tubelet, not image" in error
