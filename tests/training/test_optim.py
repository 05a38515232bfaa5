"""Learning rates and parameter groups."""

import io
import json
from collections.abc import Callable
from typing import Any

import pytest
import torch

from paths import GOLDEN
from vjepa2_ac.config import TrainingConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import newest_checkpoint, read_torch, write_manifest, write_torch
from vjepa2_ac.training import optim
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.optim import learning_rate_at, load_moments, make_optimizer, parameter_groups


def test_warmup_stable_decay_equals_the_official_schedule() -> None:
    expected = json.loads((GOLDEN / "schedules.json").read_text())["warmup_stable_decay"]
    training = TrainingConfig(
        steps=expected["steps"],
        warmup_steps=expected["warmup_steps"],
        decay_steps=expected["decay_steps"],
        learning_rate=expected["peak_lr"],
        schedule="warmup_stable_decay",
    )
    first = training.warmup_steps  # the official warm-up starts above 0, this one at 0
    rates = [learning_rate_at(step, training) for step in range(first, 201)]
    assert rates == pytest.approx(expected["lr_at_step_1_to_200"][first - 1 :], rel=1e-9, abs=1e-15)


@pytest.mark.parametrize(("schedule", "middle", "end"), [("cosine", 5e-4, 0.0), ("warmup_stable_decay", 1e-3, 1e-3)])
def test_schedule_warms_up_linearly_and_decays_to_the_end(schedule: str, middle: float, end: float) -> None:
    training = TrainingConfig(steps=100, warmup_steps=10, learning_rate=1e-3, schedule=schedule)
    selected_rates = [learning_rate_at(step, training) for step in (5, 10, 55, 100)]
    assert selected_rates == pytest.approx([5e-4, 1e-3, middle, end])
    rates = [learning_rate_at(step, training) for step in range(10, 101)]
    assert rates == sorted(rates, reverse=True)


def test_weight_decay_excludes_biases_norms_and_frozen_weights() -> None:
    module = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.LayerNorm(4), torch.nn.Linear(4, 2))
    module[2].requires_grad_(requires_grad=False)
    decayed, exempt = parameter_groups(module, 0.04)
    assert decayed["params"] == [module[0].weight]
    assert decayed["weight_decay"] == 0.04
    assert exempt["params"] == [module[0].bias, module[1].weight, module[1].bias]
    assert exempt["weight_decay"] == 0.0


@pytest.fixture
def fuse(monkeypatch: pytest.MonkeyPatch) -> Callable[[bool], None]:
    """Return a function that sets whether AdamW is fused, which also works on a CPU."""
    return lambda fused: monkeypatch.setattr(optim, "_are_on_cuda", lambda _: fused)


def moments_of(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Return the state of an optimizer as in a checkpoint."""
    buffer = io.BytesIO()
    torch.save(optimizer.state_dict(), buffer)
    buffer.seek(0)
    return dict(torch.load(buffer, weights_only=True, map_location="cpu"))


@pytest.mark.parametrize("kinds", [(False, True)])
def test_resume_converts_moments_between_fused_and_plain_optimizer(
    fuse: Callable[[bool], None], kinds: tuple[bool, bool]
) -> None:
    training = TrainingConfig(learning_rate=1e-2)
    weights = []
    for before, after in ((False, False), kinds):
        torch.manual_seed(0)
        module, resumed = torch.nn.Linear(128, 8), torch.nn.Linear(128, 8)
        fuse(before)
        optimizer = make_optimizer(module, training)
        take_steps(module, optimizer, range(3))
        fuse(after)
        resumed.load_state_dict(module.state_dict())
        resumed_optimizer = make_optimizer(resumed, training)
        load_moments(resumed_optimizer, moments_of(optimizer))
        assert [bool(group["fused"]) for group in resumed_optimizer.param_groups] == [after, after]
        assert resumed_optimizer.state_dict()["state"].keys() == optimizer.state_dict()["state"].keys()
        for index, state in optimizer.state_dict()["state"].items():
            for name, value in state.items():
                restored = resumed_optimizer.state_dict()["state"][index][name]
                assert restored.dtype == value.dtype
                assert torch.equal(restored, value)
        take_steps(resumed, resumed_optimizer, range(3, 6))
        assert all(state["step"] == 6 for state in resumed_optimizer.state.values())
        weights.append(resumed.weight)
    torch.testing.assert_close(weights[1], weights[0], rtol=1e-5, atol=1e-7)


def take_steps(module: torch.nn.Linear, optimizer: torch.optim.Optimizer, seeds: range) -> None:
    for seed in seeds:
        inputs = torch.randn(5, 128, generator=torch.Generator().manual_seed(seed))
        module(inputs).square().mean().backward()
        optimizer.step()
        optimizer.zero_grad()


@pytest.mark.parametrize("changes", [{"state": {0: {"momentum": 3}}}, {}], ids=str)
def test_moments_of_another_optimizer_raise(changes: dict[str, Any], make_config, reporter) -> None:
    config = make_config(training__steps=1)
    checkpoint = newest_checkpoint(train(config, reporter) / "checkpoints")
    optimizer_state = read_torch(checkpoint / "optimizer.pt") | changes
    with (checkpoint / "optimizer.pt").open("wb") as file:
        write_torch(optimizer_state if changes else [3], file)
    write_manifest(checkpoint)
    with pytest.raises(InputError, match="not the state of this run"):
        train(make_config(training__steps=2), reporter, allow_config_change=True)
