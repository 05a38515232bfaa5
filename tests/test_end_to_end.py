"""The whole way on the command line: record, train from scratch, export, adapt with LoRA, evaluate."""

import json
from pathlib import Path

import pytest
import yaml

from paths import ROOT
from vjepa2_ac.cli import main
from vjepa2_ac.runs.metrics_log import read_metrics_log

TINY = {
    "image_size": 48,
    "encoder": {"width": 24, "depth": 1, "heads": 2},
    "predictor": {"width": 24, "depth": 1, "heads": 2},
}


def write_config(folder: Path, name: str, **sections: object) -> str:
    values = {
        "run_dir": str(folder / name),
        "data": {
            "path": str(folder / "data"), "frames": 3, "stride": 4, "validation_share": 0.3, "test_share": 0.3,
            "workers": 0,
        },
        "training": {
            "steps": 3, "batch_size": 2, "accumulation": 1, "warmup_steps": 0, "precision": "fp32", "device": "cpu",
            "allow_weak_base": True,
        },
        "validation": {"every": 3, "clips": 4, "batch_size": 2, "ranking_samples": 4},
        "checkpoint": {"every": 3},
        **sections,
    }  # fmt: skip
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(values))
    return str(path)


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set, a base made from scratch, and an adapter on it, all made by commands."""
    folder = tmp_path_factory.mktemp("workshop")
    data = str(folder / "data")
    assert main(["simulate", "record", data, "--domain", "B", "--episodes", "10", "--steps", "14"]) == 0
    scratch = write_config(
        folder, "scratch", model={"base": "random", "sizes": TINY, "dtype": "float32"}, adapter={"kind": "none"}
    )
    assert main(["train", scratch]) == 0
    assert main(["export", str(folder / "scratch"), str(folder / "base")]) == 0
    lora = write_config(folder, "lora", model={"base": str(folder / "base"), "dtype": "float32"})
    assert main(["train", lora, "--check", "seed=3"]) == 0
    assert not (folder / "lora").exists()
    assert main(["train", lora]) == 0
    return folder


FEW = ["--ranking-clips=2", "--samples=6", "--landscapes=1", "--nodes=3", "--examples=1"]
NEWEST = ["--checkpoint", "newest"]  # not the base, which may be selected after so few steps


def of_model(metrics: dict, model: str, key: str) -> list[float]:
    """Return the values of the rows of a model whose key begins so."""
    return [row["value"] for row in metrics["rows"] if row["model"] == model and row["key"].startswith(key)]


def test_evaluate_ends_with_the_result_in_words_a_picture_and_paths(
    workshop: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(workshop / "lora"), *NEWEST, "--clips", "8", "--all", *FEW]) == 0
    printed = capsys.readouterr().out
    result = json.loads((workshop / "lora" / "metrics.json").read_text())
    assert " ".join(result["summary"]["sentence"].split()) in " ".join(printed.split())
    assert str(workshop / "lora" / "report.html") in printed
    assert (workshop / "lora" / "evaluation.png").read_bytes().startswith(b"\x89PNG")
    assert list(result["by_clip"]["models"]) == ["base", "adapter"]
    assert len(of_model(result, "adapter", "rollout.l1.over_persistence.")) == 2
    for word in ("persistence", "base", "adapter", "0.27 s ahead", "zero actions", "shuffled actions"):
        assert word in printed


WRONG = {
    "no such config": (["train", "nowhere.yaml"], "nowhere.yaml"),
    "a folder without --resume": (["train", "{here}/lora"], "--resume"),
    "resume of no run": (["train", "{here}", "--resume"], "no config.yaml"),
    "resume with overrides": (["train", "{here}/lora", "--resume", "seed=3"], "differs in seed"),
    "evaluate no run": (["evaluate", "{here}"], "no config.yaml"),
    "export over something": (["export", "{here}/lora", "{here}/base"], "something is there already"),
    "another config": (["train", "{here}/lora.yaml", "adapter.rank=3"], "adapter.rank"),
    "no data": (["train", "{here}/lora.yaml", "run_dir={here}/x", "data.path={here}/nowhere"], "nowhere"),
    "no model": (["train", "{here}/lora.yaml", "run_dir={here}/x", "model.base={here}/no.pt"], "vjepa2-ac download"),
    "clips longer than episodes": (["train", "{here}/lora.yaml", "run_dir={here}/x", "data.frames=16"], "61"),
    "no test episodes": (["train", "{here}/lora.yaml", "run_dir={here}/x", "data.validation_share=0.0"], "validation"),
    "a target that is not there": (["train", "{here}/lora.yaml", "run_dir={here}/x", "adapter.targets=[qkv]"], "qkv"),
}


@pytest.mark.parametrize(("arguments", "complaint"), WRONG.values(), ids=WRONG.keys())
def test_wrong_input_is_one_clear_error(
    workshop: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], complaint: str
) -> None:
    assert main([word.format(here=workshop) for word in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert complaint in error
    assert "Traceback" not in error
    assert not (workshop / "x").exists()


def test_real_robot_pictures_go_the_whole_way_and_the_error_falls(shared: Path, tmp_path: Path) -> None:
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
