"""Benchmarks, imported as where they lie, for they import each other by their bare names; and a stand-in of another."""

import sys
from collections.abc import Callable, Iterator
from importlib import import_module
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
"""Stands where the official predictor is, and computes something else."""


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Any]]:
    """Import benchmarks by their names; nothing of them stays."""
    threads, before = torch.get_num_threads(), set(sys.modules)
    monkeypatch.setattr(sys, "path", [str(ROOT / "benchmarks"), *sys.path])
    monkeypatch.delitem(sys.modules, "planning", raising=False)  # a folder of tests has this name, too
    yield import_module
    torch.set_num_threads(threads)
    own = {path.stem for path in (ROOT / "benchmarks").glob("*.py")} | {"src", "notebooks"}
    for module in set(sys.modules) - before:
        if module.split(".")[0] in own:
            del sys.modules[module]
