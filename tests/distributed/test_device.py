"""Unsupported precision raises in every command before loading; slow precision on a CPU causes a warning."""

import importlib
import importlib.util
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from vjepa2_ac import distributed
from vjepa2_ac.cli import main
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.distributed import select_device
from vjepa2_ac.model.model_files import find_base

COMMANDS = {
    "train": ["train", "CONFIG"],
    "encode": ["encode", "CONFIG"],
    "evaluate": ["evaluate", "model", "--data", "CONFIG", "--out", "out"],
    "calibrate": ["data", "calibrate", "CONFIG"],
    "decoder": ["decoder", "CONFIG"],
    "plan": [
        "plan", "model", "--config", "CONFIG", "--start", "seen.png", "--goal", "seen.png", "--state",
        "0.4,0,0.3,3.1,0,0.1,0.2",
    ],
    "simulate": ["simulate", "model", "--config", "CONFIG"],
}  # fmt: skip
UNDER_AUTOCAST = ("train", "encode", "evaluate", "calibrate", "decoder")


@pytest.fixture(params=[(7, 5)])
def gpu(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a GPU of this compute capability that cannot execute anything."""
    # peft imports bitsandbytes, whose import fails later: CUDA is simulated, but torch is built without it.
    importlib.import_module("peft")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda *_, **__: True)  # bfloat16 is emulated
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda *_: request.param)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda *_: "Tesla T4")


def values(**training: str) -> dict[str, Any]:
    return {
        "run_dir": "run",
        "data": {"path": "data", "stride": 4},
        "model": {"base": "model", "dtype": training.pop("dtype", "bfloat16")},
        "training": training,
    }


def parsed(**training: str) -> Config:
    return parse_config(values(**training), where="test")


def run_command(command: str, monkeypatch: pytest.MonkeyPatch, folder: Path, **training: str) -> int:
    if command == "simulate" and importlib.util.find_spec("mujoco") is None:
        pytest.skip("MuJoCo (extra sim) is not installed")
    monkeypatch.chdir(folder)
    Path("config.yaml").write_text(yaml.safe_dump(values(**training)))
    for name in ("data", "model"):  # the commands check that both exist before they check the device
        Path(name).mkdir(exist_ok=True)
    shutil.copy(find_base("builtin:sim-tiny") / "config.json", "model")
    Image.fromarray(np.zeros((16, 16, 3), dtype=np.uint8)).save("seen.png")
    return main([word.replace("CONFIG", "config.yaml") for word in COMMANDS[command]])


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize("command", COMMANDS)
def test_emulated_bfloat16_raises(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(command, monkeypatch, tmp_path) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "Tesla T4 of compute capability 7.5" in message
    assert "8.0 or more" in message
    assert ("training.precision: bf16" in message) == (command in UNDER_AUTOCAST)
    assert ("Set training.precision=fp16" if command in UNDER_AUTOCAST else "Set model.dtype=float32") in message


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize(
    "training", [{"precision": "fp16"}, {"precision": "fp32", "dtype": "float32"}, {"device": "cpu"}], ids=str
)
def test_supported_precision_on_old_gpu_is_accepted(training: dict[str, str]) -> None:
    assert select_device(parsed(**training).training).type == training.get("device", "cuda")


def test_slow_bfloat16_on_a_cpu_causes_a_warning_with_a_fix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(distributed, "measure_matmul_speed", lambda _, dtype: 1e9 if dtype == torch.bfloat16 else 6e10)
    distributed._warn_if_slow.cache_clear()
    run_command("train", monkeypatch, tmp_path)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert "60 times as long as in float32" in line
    assert line.endswith("Set training.precision=fp32 with model.dtype=float32")
