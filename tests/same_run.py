"""Are two runs the same, bit for bit? Weights, optimizer state and figures but for timings."""

from pathlib import Path

import torch
from safetensors.torch import load_file

from vjepa2_ac.training.checkpoint import newest_checkpoint
from vjepa2_ac.training.health import MEASURED
from vjepa2_ac.training.journal import read_journal

TIMINGS = MEASURED  # figures of the machine


def trained_weights(run: Path) -> dict[str, torch.Tensor]:
    return load_file(newest_checkpoint(run / "checkpoints") / "adapter" / "adapter_model.safetensors")


def optimizer_state(run: Path) -> dict:
    return torch.load(newest_checkpoint(run / "checkpoints") / "optimizer.pt", weights_only=True)["state"]


def figures(run: Path) -> list[dict]:
    """Return the rows of numbers: a warning's words name knobs that two runs of the same weights may differ in."""
    rows = [row for row in read_journal(run / "metrics.jsonl") if row["kind"] != "warning"]
    return [{k: v for k, v in row.items() if k not in TIMINGS} for row in rows]


def assert_same_run(one: Path, other: Path) -> None:
    first, second = trained_weights(one), trained_weights(other)
    assert first.keys() == second.keys()
    assert all(torch.equal(first[key], second[key]) for key in first)
    for key, moments in optimizer_state(one).items():
        for name, value in moments.items():
            assert torch.equal(value, optimizer_state(other)[key][name]), (key, name)
    assert figures(one) == figures(other)
