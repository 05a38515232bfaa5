"""Comparison of two runs, bit for bit: weights, optimizer state and metrics except timings."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from vjepa2_ac.runs.checkpoint import newest_checkpoint
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.training.monitoring import MACHINE_METRICS

TIMINGS = MACHINE_METRICS  # metrics of the machine


def trained_weights(run: Path) -> dict[str, torch.Tensor]:
    return load_file(newest_checkpoint(run / "checkpoints") / "adapter" / "adapter_model.safetensors")


def all_weights(run: Path) -> dict[str, torch.Tensor]:
    """Return all trained weights of a run of any kind."""
    folder = newest_checkpoint(run / "checkpoints") / "adapter"
    files = sorted(folder.rglob("*.safetensors"))
    return {f"{file.name} {name}": value for file in files for name, value in load_file(file).items()}


def optimizer_state(run: Path) -> dict:
    return torch.load(newest_checkpoint(run / "checkpoints") / "optimizer.pt", weights_only=True)["state"]


def metrics(run: Path) -> list[dict]:
    """Return all rows except warnings, without timings. Warnings depend on the files that a run has."""
    rows = [row for row in read_metrics_log(run / "metrics.jsonl") if row["kind"] != "warning"]
    return [{k: v for k, v in row.items() if k not in TIMINGS} for row in rows]


def numbers_in(state: dict, prefix: str = "") -> dict[str, torch.Tensor]:
    """Return all numbers of nested dicts by their dotted keys; 8-bit moments are nested."""
    inner = [numbers_in(value, f"{prefix}{key}.") for key, value in state.items() if isinstance(value, dict)]
    tensors = {f"{prefix}{key}": torch.as_tensor(value) for key, value in state.items() if not isinstance(value, dict)}
    return {name: value for numbers in (tensors, *inner) for name, value in numbers.items()}


def assert_same_run(run: Path, other_run: Path) -> None:
    for first, second in (
        (all_weights(run), all_weights(other_run)),
        (numbers_in(optimizer_state(run)), numbers_in(optimizer_state(other_run))),
    ):
        assert first
        assert first.keys() == second.keys()
        for name, value in first.items():
            assert torch.equal(value, second[name]), name
    assert metrics(run) == metrics(other_run)


def assert_equal_up_to_rounding(run: Path, other_run: Path) -> None:
    """Compare two runs with different numbers of processes, whose sums have another order."""
    first, second = trained_weights(run), trained_weights(other_run)
    for name, value in first.items():
        torch.testing.assert_close(second[name], value, rtol=1e-3, atol=1e-6, msg=name)
    for row, other_row in zip(metrics(run), metrics(other_run), strict=True):
        assert row["step"] == other_row["step"]
        if row["kind"] == "train":
            assert other_row["loss"] == pytest.approx(row["loss"], rel=1e-5)
            assert other_row["grad_norm"] == pytest.approx(row["grad_norm"], rel=1e-4)
