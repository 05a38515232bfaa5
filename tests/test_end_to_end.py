"""All commands in sequence: record, train from scratch or on a pretrained encoder, export, adapt, evaluate."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from paths import GOLDEN, ROOT
from run_fixtures import tiny_config
from vjepa2_ac.cli import main
from vjepa2_ac.config import ModelConfig
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.runs.subject import load_subject

TINY = {
    "image_size": 48,
    "encoder": {"width": 24, "depth": 1, "heads": 2},
    "predictor": {"width": 24, "depth": 1, "heads": 2},
}


def write_config(folder: Path, name: str, **changes: object) -> str:
    small_values = {"data__frames": 3, "data__stride": 4, "data__test_share": 0.3, "training__accumulation": 1}
    small_values |= {"training__steps": 3, "training__warmup_steps": 0, "checkpoint__every": 3}
    config = tiny_config(folder / name, folder / "data", folder / "base", **(small_values | changes))
    (folder / f"{name}.yaml").write_text(config_as_yaml(config))
    return str(folder / f"{name}.yaml")


@pytest.fixture(scope="module")
def trained_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create a data set, a base model trained from scratch and an adapter, all with commands."""
    folder = tmp_path_factory.mktemp("workshop")
    data = str(folder / "data")
    assert main(["simulate", "record", data, "--domain", "B", "--episodes", "10", "--steps", "14"]) == 0
    scratch = write_config(
        folder, "scratch", model={"base": "random", "sizes": TINY, "dtype": "float32"}, adapter={"kind": "none"}
    )
    assert main(["train", scratch]) == 0
    assert main(["export", str(folder / "scratch"), str(folder / "base")]) == 0
    lora = write_config(folder, "lora")
    assert main(["train", lora, "--check", "seed=3"]) == 0
    assert not (folder / "lora").exists()
    assert main(["train", lora]) == 0
    return folder


FEW = ["--ranking-clips=2", "--samples=6", "--landscapes=1", "--nodes=3", "--examples=1"]
NEWEST = ["--checkpoint", "newest"]  # not the base, which may be selected after so few steps


def metric_of(metrics: dict, model: str, key: str) -> list[float]:
    """Return the values of a model's rows whose key starts with `key`."""
    return [row["value"] for row in metrics["rows"] if row["model"] == model and row["key"].startswith(key)]


def test_evaluate_prints_result_image_and_paths(trained_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(trained_folder / "lora"), *NEWEST, "--clips", "8", "--all", *FEW]) == 0
    printed = capsys.readouterr().out
    result = json.loads((trained_folder / "lora" / "metrics.json").read_text())
    assert " ".join(result["summary"]["sentence"].split()) in " ".join(printed.split())
    assert str(trained_folder / "lora" / "report.html") in printed
    assert (trained_folder / "lora" / "evaluation.png").read_bytes().startswith(b"\x89PNG")
    assert list(result["by_clip"]["models"]) == ["base", "adapter"]
    assert len(metric_of(result, "adapter", "rollout.l1.over_persistence.")) == 2
    for word in ("persistence", "base", "adapter", "0.27 s ahead", "zero actions", "shuffled actions"):
        assert word in printed


WRONG = {
    "no such config": (["train", "nowhere.yaml"], "nowhere.yaml"),
    "a folder without --resume": (["train", "{here}/lora"], "--resume"),
    "resume of no run": (["train", "{here}", "--resume"], "no config.yaml"),
    "resume with overrides": (["train", "{here}/lora", "--resume", "seed=3"], "differs in seed"),
    "evaluate no run": (["evaluate", "{here}"], "a folder without config.yaml"),
    "no data": (["train", "{here}/lora.yaml", "run_dir={here}/x", "data.path={here}/nowhere"], "nowhere"),
    "clips longer than episodes": (["train", "{here}/lora.yaml", "run_dir={here}/x", "data.frames=16"], "61"),
    "no test episodes": (["train", "{here}/lora.yaml", "run_dir={here}/x", "data.validation_share=0.0"], "validation"),
}


@pytest.mark.parametrize(("arguments", "message"), WRONG.values(), ids=WRONG.keys())
def test_wrong_input_prints_one_error(
    trained_folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main([word.format(here=trained_folder) for word in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert "Traceback" not in error
    assert not (trained_folder / "x").exists()


def test_training_on_real_robot_frames_lowers_the_error(shared: Path, tmp_path: Path) -> None:
    data = shared / "data/bridge_rlds/bridge_dataset/1.0.0"
    config = str(ROOT / "configs/bridge.yaml")
    overrides = [f"data.path={data}", f"run_dir={tmp_path / 'run'}", "training.steps=20", "validation.every=20"]
    overrides += ["validation.ranking_samples=4", "validation.ranking_clips=4"]
    assert main(["train", config, *overrides]) == 0
    rows = list(read_metrics_log(tmp_path / "run" / "metrics.jsonl"))
    losses = [row["loss"] for row in rows if row["kind"] == "train"]
    errors = [row["error_over_persistence"] for row in rows if row["kind"] == "validation"]
    assert losses[-1] < 0.95 * losses[0]
    assert errors[-1] < 0.9 * errors[0]


# On a pretrained encoder: record, encode, train, export

ENCODER = {"path": str(GOLDEN / "encoders" / "vjepa2_1_distilled.pt"), "heads": 4}
MODEL = {
    "base": "random",
    "encoder": ENCODER,
    "sizes": {"image_size": 96, "predictor": {"width": 64, "depth": 2, "heads": 4}},
    "dtype": "float32",
}


def config_of_encoder(folder: Path, name: str, model: dict[str, object] = MODEL, **changes: object) -> str:
    cache = {"data__cache": "require", "data__cache_dir": str(folder / "latents")}
    return write_config(folder, name, model=model, **({"adapter": {"kind": "none"}} | cache | changes))


@pytest.fixture(scope="module")
def encoder_folder(trained_folder: Path) -> Path:
    """Return the same folder after encoding its data and training on the latents."""
    config = config_of_encoder(trained_folder, "whole")
    assert main(["encode", config]) == 0
    assert main(["train", config, "--check"]) == 0
    assert main(["train", config]) == 0
    return trained_folder


def test_export_can_be_used_as_base_model(encoder_folder: Path, tmp_path: Path) -> None:
    assert main(["export", str(encoder_folder / "whole"), str(tmp_path / "merged")]) == 0
    assert main(["export", str(encoder_folder / "whole"), str(tmp_path / "official.pt"), "--to", "official"]) == 0
    run = load_subject(encoder_folder / "whole").world_model.eval()
    sizes = {"image_size": 96, "encoder": {"heads": 4}, "predictor": {"width": 64, "heads": 4}}
    rng = np.random.default_rng(0)
    frames = torch.from_numpy(rng.normal(size=(1, 2, 3, 96, 96))).float()
    numbers = torch.from_numpy(rng.normal(size=(1, 2, 7))).float() * 0.1
    latents = run.encode(frames)
    expected = run.predict(latents, numbers, numbers)
    for base in (tmp_path / "merged", tmp_path / "official.pt"):
        values = {"base": str(base), "dtype": "float32"} | ({"sizes": sizes} if base.suffix else {})
        model = load_base(ModelConfig.model_validate(values), seed=0)
        assert torch.equal(model.encode(frames), latents)
        assert torch.allclose(model.predict(latents, numbers, numbers), expected, atol=1e-6)
    card = json.loads((tmp_path / "merged" / "config.json").read_text())
    origin = {"file": "vjepa2_1_distilled.pt", "key": "ema_encoder", "licence": "", "heads_are_told": True}
    assert card["encoder_origin"] == origin
    lora = config_of_encoder(
        encoder_folder, "adapted", {"base": str(tmp_path / "merged"), "dtype": "float32"}, adapter={"rank": 2}
    )
    assert main(["train", lora, "training.steps=1"]) == 0  # on the same latents: the cache is required
    assert main(["export", str(encoder_folder / "adapted"), str(tmp_path / "hub"), "--to", "hub"]) == 0
    words = "V-JEPA 2.1, 12 blocks of 64, 4 heads, each frame as a tubelet; from vjepa2_1_distilled.pt, ema_encoder"
    assert words in (tmp_path / "hub" / "README.md").read_text()
    assert json.loads((tmp_path / "hub" / "vjepa2_ac.json").read_text())["encoder_in_words"] == words


def test_latents_of_another_frame_input_raise(encoder_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = config_of_encoder(encoder_folder, "image", {**MODEL, "encoder": {**ENCODER, "frame": "image"}})
    assert main(["train", config]) == 2
    error = capsys.readouterr().err
    assert "no latent cache for this model" in error
    assert "encoder.frame: tubelet, not image" in error
