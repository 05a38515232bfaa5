"""LPIPS and FVD by files that are named on the command line: in metrics.json, report and console, or null with why."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from metric_files import know_i3d, know_lpips, write_i3d, write_lpips
from random_decoder import write_decoder
from run_fixtures import one_thread
from synthetic import write_synthetic_droid
from vjepa2_ac.cli import main
from vjepa2_ac.evaluation.video.record import FVD_MEANING, LPIPS_MEANING, NO_I3D, NO_LPIPS
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.config.loading import parse_config

QUICK = ["--sensitivity-clips", "0", "--examples", "0"]


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a config of clips of 12 frames, of 20 clips of five test episodes or more."""
    folder = tmp_path_factory.mktemp("metrics")
    data = write_synthetic_droid(folder / "set", episodes=12, steps=18, size=(36, 64))
    values = {
        "data": {
            "path": str(data), "frames": 12, "stride": 1, "validation_share": 0.1, "test_share": 0.7, "workers": 0,
        },
        "model": {"base": "builtin:sim-tiny", "dtype": "float32"},
        "training": {"precision": "fp32", "device": "cpu"},
        "validation": {"batch_size": 8},
    }  # fmt: skip
    (folder / "config.yaml").write_text(yaml.safe_dump(values))
    return folder / "config.yaml"
