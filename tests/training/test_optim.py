"""Learning rates and parameter groups."""

import json
from itertools import pairwise

import pytest
import torch
from pydantic import ValidationError

from paths import GOLDEN
from vjepa2_ac.config import TrainingConfig
from vjepa2_ac.training.optim import learning_rate_at, make_optimizer, parameter_groups


def test_warmup_stable_decay_equals_the_official_schedule() -> None:
    expected = json.loads((GOLDEN / "schedules.json").read_text())["warmup_stable_decay"]
    training = TrainingConfig(
        steps=expected["steps"],
        warmup_steps=expected["warmup_steps"],
        decay_steps=expected["decay_steps"],
        start_learning_rate=expected["start_lr"],
        learning_rate=expected["peak_lr"],
        final_learning_rate=expected["final_lr"],
        schedule="warmup_stable_decay",
    )
    rates = [learning_rate_at(step, training) for step in range(1, 201)]
    assert rates == pytest.approx(expected["lr_at_step_1_to_200"], rel=1e-9, abs=1e-15)


def test_cosine_rises_linearly_to_the_peak_and_falls_to_the_end() -> None:
    training = TrainingConfig(steps=100, warmup_steps=10, learning_rate=1e-3, final_learning_rate=1e-5)
    assert learning_rate_at(5, training) == pytest.approx(5e-4)
    assert learning_rate_at(10, training) == pytest.approx(1e-3)
    assert learning_rate_at(55, training) == pytest.approx((1e-3 + 1e-5) / 2)
    assert learning_rate_at(100, training) == pytest.approx(1e-5)
    rates = [learning_rate_at(step, training) for step in range(10, 101)]
    assert rates == sorted(rates, reverse=True)


def test_linear_rises_to_the_peak_and_falls_in_a_straight_line() -> None:
    training = TrainingConfig(
        steps=100, warmup_steps=10, learning_rate=1e-3, final_learning_rate=1e-5, schedule="linear"
    )
    assert [learning_rate_at(step, training) for step in (5, 10)] == pytest.approx([5e-4, 1e-3])
    rates = [learning_rate_at(step, training) for step in range(10, 101)]
    falls = [before - after for before, after in pairwise(rates)]
    assert falls == pytest.approx([(1e-3 - 1e-5) / 90] * 90)
    assert rates[-1] == pytest.approx(1e-5)


def test_constant_rises_to_the_peak_and_stays() -> None:
    training = TrainingConfig(steps=100, warmup_steps=10, learning_rate=1e-3, schedule="constant")
    assert learning_rate_at(5, training) == pytest.approx(5e-4)
    assert {learning_rate_at(step, training) for step in range(10, 101)} == {1e-3}
    with pytest.raises(ValidationError, match="leave final_learning_rate out"):
        TrainingConfig(schedule="constant", final_learning_rate=1e-5)


def test_a_schedule_without_warmup_starts_near_the_peak() -> None:
    training = TrainingConfig(steps=1000, warmup_steps=0, learning_rate=1e-3)
    assert learning_rate_at(1, training) == pytest.approx(1e-3, rel=1e-3)


def test_steps_count_from_one() -> None:
    with pytest.raises(ValueError, match="count from 1"):
        learning_rate_at(0, TrainingConfig())


def test_weight_decay_spares_biases_and_norms_and_frozen_weights_are_left_out() -> None:
    module = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.LayerNorm(4), torch.nn.Linear(4, 2))
    module[2].requires_grad_(requires_grad=False)
    decayed, exempt = parameter_groups(module, 0.04)
    assert decayed["params"] == [module[0].weight]
    assert decayed["weight_decay"] == 0.04
    assert exempt["params"] == [module[0].bias, module[1].weight, module[1].bias]
    assert exempt["weight_decay"] == 0.0
    optimizer = make_optimizer(module, TrainingConfig(betas=(0.8, 0.9)))
    assert optimizer.defaults["betas"] == (0.8, 0.9)
