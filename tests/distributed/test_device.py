"""Unsupported arithmetic of a GPU: refused by every entry point, before anything is read or loaded."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from vjepa2_ac.cli import main
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.distributed.device import computing_device, require_type_of_weights
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.session import load_to_plan

DOORS = {
    "train": ["train", "CONFIG"],
    "encode": ["encode", "CONFIG"],
    "evaluate": ["evaluate", "no such model", "--data", "CONFIG", "--out", "out", "--planning"],
    "calibrate": ["data", "calibrate", "CONFIG"],
    "plan": [
        "plan", "no such model", "--config", "CONFIG", "--start", "seen.png", "--goal", "seen.png", "--state",
        "0.4,0,0.3,3.1,0,0.1,0.2",
    ],
    "simulate": ["simulate", "no such model", "--config", "CONFIG"],
}  # fmt: skip
UNDER_AUTOCAST = ("train", "encode", "evaluate", "calibrate")


@pytest.fixture(params=[(7, 5)])
def gpu(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with a GPU of this compute capability, on which nothing can be done."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda *_, **__: True)  # it emulates
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda *_: request.param)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda *_: "Tesla T4")


def values(**training: str) -> dict[str, Any]:
    return {
        "run_dir": "run",
        "data": {"path": "no such data", "stride": 4},
        "model": {"base": "no such model", "dtype": training.pop("dtype", "bfloat16")},
        "training": training,
    }


def parsed(**training: str) -> Config:
    return parse_config(values(**training), where="test")


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize("door", DOORS)
def test_bfloat16_that_is_only_emulated_is_refused(
    door: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if door == "simulate" and importlib.util.find_spec("mujoco") is None:
        pytest.skip("MuJoCo (extra sim) is not installed")
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text(yaml.safe_dump(values()))
    for name in ("no such data", "no such model"):  # of which the doors ask only whether it is there, before the device
        Path(name).mkdir()
    Image.fromarray(np.zeros((16, 16, 3), dtype=np.uint8)).save("seen.png")
    assert main([word.replace("CONFIG", "config.yaml") for word in DOORS[door]]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "Tesla T4 of compute capability 7.5" in said
    assert "8.0 or more" in said
    assert ("training.precision: bf16" in said) == (door in UNDER_AUTOCAST)
    assert ("Set training.precision=fp16" if door in UNDER_AUTOCAST else "Set model.dtype=float32") in said


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize(
    "training", [{"precision": "fp16"}, {"precision": "fp32", "dtype": "float32"}, {"device": "cpu"}], ids=str
)
def test_what_an_old_gpu_computes_is_not_refused(training: dict[str, str]) -> None:
    assert computing_device(parsed(**training).training).type == training.get("device", "cuda")


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize("gpu", [(8, 0), (8, 9), (9, 0), (12, 0)], indirect=True)
def test_since_ampere_there_is_bfloat16() -> None:
    config = parsed(precision="bf16")
    assert computing_device(config.training) == torch.device("cuda", 0)
    require_type_of_weights(config.model, torch.device("cuda"))


@pytest.mark.usefixtures("gpu")
def test_the_gpu_of_this_process_is_the_one_that_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: (7, 5) if index else (8, 6))
    assert computing_device(parsed().training) == torch.device("cuda", 0)
    monkeypatch.setenv("LOCAL_RANK", "3")
    with pytest.raises(InputError, match=r"compute capability 7\.5"):
        computing_device(parsed().training)


@pytest.mark.usefixtures("gpu")
def test_a_model_without_a_config_is_planned_with_in_what_the_gpu_computes() -> None:
    with pytest.raises(InputError, match="no such model: no such file or folder"):  # and not its type
        load_to_plan("no such model")
