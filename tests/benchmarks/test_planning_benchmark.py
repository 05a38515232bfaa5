"""The benchmark of decisions times what decides alike, each in the type and with the goal that were asked for."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benches import ELSEWHERE

DECISION = re.compile(r"^ +(\d+)  (\S+) +(\S+) +(\S+) +\S+ +(\S+)% +0 +(\S+) +(\S+)(?:  \[.*)?$", re.MULTILINE)
"""Horizon, way, seconds, the least, MFU, ratio to plain, ratio to official."""


def test_quick_benchmark_of_a_decision_completes_without_the_official_code(
    load: Callable[[str], Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    load("planning").main(["--quick", "--no-memory", "--official", str(tmp_path), "--profile", "--dtype", "bfloat16"])
    printed = capsys.readouterr().out
    assert f"official: skipped, for there is no {tmp_path}" in printed
    assert "aten::addmm" in printed
    lines = DECISION.findall(printed)
    ways = ["plain", "ours/4", "ours/2", "ours/4+adapter"]
    assert [(horizon, way) for horizon, way, *_ in lines] == [("2", way) for way in ways]
    for _, _, seconds, least, mfu, of_plain, of_official in lines:
        assert 0 < float(least) <= float(seconds)
        assert min(float(mfu), float(of_plain)) >= 0  # rounded
        assert of_official == "-"
    assert lines[0][5] == "1.00"


NOTEBOOK = """
import torch

class WorldModel:
    def __init__(self, mpc_args, device, **_):
        self.asked = mpc_args

    def infer_next_action(self, rep, pose, goal_rep):
        assert rep.shape == goal_rep.shape == (1, 4, 128)
        assert pose.shape == (1, 1, 7)
        assert not torch.is_grad_enabled()
        assert torch.initial_seed() == 0
        assert sorted(self.asked) == [
            "cem_steps", "maxnorm", "momentum_mean", "momentum_mean_gripper", "momentum_std", "momentum_std_gripper",
            "rollout", "samples", "topk",
        ]
        return torch.zeros(self.asked["rollout"], 7) if torch.randn(3, device="cpu").any() else None
"""


def test_no_ratio_is_printed_to_a_notebook_that_plans_otherwise(
    load: Callable[[str], Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "src" / "models").mkdir(parents=True)
    (tmp_path / "src" / "models" / "ac_predictor.py").write_text(ELSEWHERE)
    (tmp_path / "notebooks" / "utils").mkdir(parents=True)
    (tmp_path / "notebooks" / "utils" / "world_model_wrapper.py").write_text(NOTEBOOK)
    load("planning").main(["--quick", "--no-memory", "--official", str(tmp_path)])
    printed = capsys.readouterr().out
    assert re.search(r"official: actions differ by .*: NO RATIO", printed)
    assert [way for _, way, *_ in DECISION.findall(printed)] == ["plain", "ours/4", "ours/2", "ours/4+adapter"]
