"""The flat loop of `examples/train_loop.py` equals the production loop, bit for bit."""

import runpy
from pathlib import Path

import torch

from paths import ROOT
from run_fixtures import SilentReporter
from same_run import trained_weights
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.training.loop import train

STEPS = 10


def test_ten_steps_of_the_flat_loop_equal_the_production_loop(simulated: Path, tmp_path: Path, capsys) -> None:
    model, losses = runpy.run_path(str(ROOT / "examples/train_loop.py"))["train"](str(simulated), STEPS)
    printed = capsys.readouterr().out
    assert "Before training: one-step error / persistence" in printed
    config = parse_config(
        {
            "run_dir": str(tmp_path / "run"),
            "data": {
                "path": str(simulated), "frames": 4, "stride": 4, "validation_share": 0.2, "test_share": 0.3,
                "workers": 0,
            },
            "model": {"base": "builtin:sim-tiny", "dtype": "float32"},
            "adapter": {"rank": 16, "alpha": 32, "dropout": 0.0},
            "training": {
                "steps": STEPS, "batch_size": 6, "accumulation": 1, "learning_rate": 3e-3, "warmup_steps": 5,
                "precision": "fp32", "device": "cpu", "allow_weak_base": True,
            },
            "validation": {"every": STEPS, "clips": 2, "ranking_clips": 0},
            "checkpoint": {"every": STEPS, "keep_best": "error"},
            "tracking": {"tensorboard": False},
        },
        where="test",
    )  # fmt: skip
    reporter, expected = SilentReporter(), []
    reporter.on_step = lambda _, metrics: expected.append(metrics["loss"])  # type: ignore[method-assign]
    weights = trained_weights(train(config, reporter))
    assert losses == expected
    flat_weights = {name.replace(".default", ""): value for name, value in model.predictor.state_dict().items()}
    assert weights
    for name, value in weights.items():
        assert torch.equal(flat_weights[name], value), name
