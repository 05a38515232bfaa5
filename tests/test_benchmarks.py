"""Benchmarks that nobody runs every day still run, and compare only what computes the same."""

import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch

from paths import ROOT

ELSEWHERE = """
from torch import nn

class Mixer(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, tokens):
        return self.proj(self.qkv(tokens)[..., : tokens.shape[-1]])

class Mlp(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, tokens):
        return self.fc2(self.fc1(tokens))

class Block(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attn, self.mlp = Mixer(width), Mlp(width)

    def forward(self, tokens):
        tokens = tokens + self.attn(self.norm1(tokens))
        return tokens + self.mlp(self.norm2(tokens))

class VisionTransformerPredictorAC(nn.Module):
    def __init__(self, embed_dim, predictor_embed_dim, depth, **_):
        super().__init__()
        self.predictor_embed = nn.Linear(embed_dim, predictor_embed_dim)
        self.action_encoder, self.state_encoder = (nn.Linear(7, predictor_embed_dim) for _ in range(2))
        self.extrinsics_encoder = nn.Linear(6, predictor_embed_dim)
        self.predictor_blocks = nn.ModuleList(Block(predictor_embed_dim) for _ in range(depth))
        self.predictor_norm = nn.LayerNorm(predictor_embed_dim)
        self.predictor_proj = nn.Linear(predictor_embed_dim, embed_dim)

    def forward(self, latents, actions, states):
        tokens = self.predictor_embed(latents)
        for block in self.predictor_blocks:
            tokens = block(tokens)
        return self.predictor_proj(self.predictor_norm(tokens))
"""


@pytest.fixture
def train_step(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark, imported as where it lies; nothing of it stays."""
    threads, before = torch.get_num_threads(), set(sys.modules)
    monkeypatch.setattr(sys, "path", [str(ROOT / "benchmarks"), *sys.path])
    yield import_module("train_step")
    torch.set_num_threads(threads)
    for name in set(sys.modules) - before:
        if name.split(".")[0] in {"train_step", "timed_steps", "official", "src"}:
            del sys.modules[name]


def rows(printed: str) -> list[tuple[str, float, float]]:
    """Return way, milliseconds and ratio of each line of the table."""
    found = re.findall(r"^ +\d+ +\d+ +(?:yes|no) +(\w+) +(\d+) .* (\S+)$", printed, re.MULTILINE)
    return [(way, float(ms), float(ratio)) for way, ms, ratio in found]


def test_quick_benchmark_of_a_training_step_completes_without_the_official_code(
    train_step: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train_step.main(
        ["--quick", "--no-memory", "--encoder", "--checkpointing", "off", "on", "--official", str(tmp_path)]
    )
    printed = capsys.readouterr().out
    assert f"official: skipped, for there is no {tmp_path}" in printed
    assert [way for way, _, _ in rows(printed)] == ["dense", "auto"] * 2
    assert [ratio for _, _, ratio in rows(printed)][::2] == [1.0, 1.0]


def test_peak_memory_of_one_way_is_told_as_a_number_alone(
    train_step: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train_step.main(["--quick", "--official", str(tmp_path), "--memory-of", "auto"])
    assert 0.01 < float(capsys.readouterr().out) < 100


def test_no_ratio_is_printed_to_a_predictor_that_computes_something_else(
    train_step: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "src" / "models").mkdir(parents=True)
    (tmp_path / "src" / "models" / "ac_predictor.py").write_text(ELSEWHERE)
    train_step.main(["--quick", "--no-memory", "--official", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "official: NO RATIO" in printed
    assert [way for way, _, _ in rows(printed)] == ["dense", "auto"]


def test_quick_benchmark_of_latents_tells_speed_size_and_added_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco", reason="the arm is simulated")
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import_module("latents").main(["--quick"])
    monkeypatch.delitem(sys.modules, "latents")
    printed = capsys.readouterr().out
    assert re.search(r"^ +4 +\d+\.\d+ +\d+ +\d+ +\d+\.\d\dx$", printed, re.MULTILINE)
    hours = [float(hour) for hour in re.findall(r"^ +(?:int8|bf16|fp32) +\S+ +(\d\.\d\d) +\S+$", printed, re.MULTILINE)]
    bf16, fp32, int8 = hours
    assert int8 < bf16 < fp32
    added = re.findall(r"^ +random +(\w+) +\S+ +(\S+)% +\S+ +(\S+)%", printed, re.MULTILINE)
    assert [kind for kind, *_ in added] == ["fp32", "bf16", "int8"]
    assert all(float(one) == 0 for kind, *percent in added if kind == "fp32" for one in percent)
    assert all(abs(float(one)) < 2 for _, *percent in added for one in percent)
