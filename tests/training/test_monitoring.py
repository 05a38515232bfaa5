"""Monitoring: a diverging run causes one warning per cause, and throughput metrics equal their definitions."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.distributed import measure_matmul_speed
from vjepa2_ac.runs.metrics_log import open_trackers, read_metrics_log
from vjepa2_ac.training.flops import clip_flops
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.monitoring import MACHINE_METRICS, DivergenceDetector, DivergenceWarningLog, Throughput
from vjepa2_ac.training.step import Update

CPU = torch.device("cpu")


def test_update_to_weight_covers_all_tensors() -> None:
    matrix, vector = torch.full((2, 2), 3.0), torch.tensor([8.0])  # norm: sqrt(36 + 64) = 10
    update = Update([matrix, vector])
    matrix += 0.3
    vector += 0.8
    assert update.relative_norm() == pytest.approx(1.0 / 10.0)


def test_throughput_counts_clips_tokens_and_flops_per_second() -> None:
    config = parse_config({"run_dir": "r", "data": {"path": "d", "frames": 8}, "model": {"base": "b"}}, where="test")
    sizes, speed = ModelSizes(), measure_matmul_speed(CPU, torch.bfloat16)
    throughput = Throughput.measure(config, sizes, SimpleNamespace(device=CPU, num_processes=2))
    metrics = throughput.compute_metrics(clips=12.0, seconds=4.0, waited_s=1.0)
    assert metrics["samples_per_second"] == 3.0
    assert metrics["data_wait_share"] == 0.25
    mfu = 3.0 * clip_flops(config, sizes).total / (2 * speed)
    usable = replace(throughput, ceiling=2 * mfu * throughput.ceiling)
    assert usable.compute_metrics(clips=12.0, seconds=4.0, waited_s=1.0)["mfu"] == pytest.approx(0.5)
    unusable = replace(throughput, ceiling=mfu * throughput.ceiling / 7)
    assert math.isnan(unusable.compute_metrics(clips=12.0, seconds=4.0, waited_s=1.0)["mfu"]), (
        "a utilisation of 700 % is not valid"
    )
    assert metrics["ceiling_tflops"] == pytest.approx(2 * speed / 1e12)
    assert metrics.keys() == MACHINE_METRICS


def test_training_rows_contain_run_and_machine_metrics(make_config, reporter) -> None:
    stepped: dict[int, dict[str, float]] = {}
    reporter.on_step = lambda step, metrics: stepped.update({step: metrics})
    constant = {"training__schedule": "warmup_stable_decay", "training__log_every": 2}
    folder = train(make_config(training__steps=3, **constant), reporter)
    rows = [row for row in read_metrics_log(folder / "metrics.jsonl") if row["kind"] == "train"]
    assert [row["step"] for row in rows] == [2, 3]
    for row in rows:
        assert row.keys() >= MACHINE_METRICS | {"loss", "grad_norm", "learning_rate", "update_to_weight"}
        assert 0 < row["update_to_weight"] < 1
        assert 0 < row["data_wait_share"] < 1
        assert row["mfu"] is None or 0 < row["mfu"] <= 1, "a busy machine may have no usable ceiling"
    assert "update_to_weight" not in stepped[1], "steps that are not logged must not copy the weights"
    assert not any("mfu" in note for note in reporter.notes)


# Divergence


def validation(one_step: float, rollout: float | None = None) -> dict[str, float | None]:
    return {
        "error_over_persistence": one_step,
        "rollout_over_persistence_last": one_step if rollout is None else rollout,
    }


def collect_warnings(config: Config, *rows: tuple[int, dict[str, Any]]) -> dict[int, str]:
    """Return the warnings of validations, by step."""
    detector = DivergenceDetector(config)
    warnings = {step: detector("validation", step, metrics) for step, metrics in rows}
    return {step: text for step, text in warnings.items() if text}


@pytest.fixture
def config(make_config: Callable[..., Config]) -> Config:
    return make_config(training__steps=100)


def test_validation_worse_than_the_base_model_is_reported_once(config: Config) -> None:
    warnings = collect_warnings(
        config, (0, validation(0.8)), (3, validation(0.85)), (6, validation(0.86)), (9, validation(0.7))
    )
    assert list(warnings) == [3]
    text = warnings[3]
    assert (
        "at step 3 the one-step error in validation is 0.850 of persistence's (before training 0.800); the rollout"
        in text
    )
    assert "copying" not in text


def test_loss_far_above_its_minimum_is_reported(config: Config) -> None:
    detector = DivergenceDetector(config)
    losses = [0.3, 0.5, 0.3, 0.4, 0.3] * 4 + [0.9] * 20
    warnings = {step: texts for step, loss in enumerate(losses) if (texts := detector("train", step, {"loss": loss}))}
    (step,) = warnings
    assert 20 < step < 30
    assert "the loss is 0.7, its minimum was 0.3 (medians of 10 rows)" in warnings[step]


def ranking(rank: float, low: float, high: float) -> dict[str, float]:
    return {"action_ranking_error": rank, "action_ranking_error_low": low, "action_ranking_error_high": high}


def test_better_prediction_with_worse_ranking_is_reported_once(config: Config) -> None:
    start = validation(0.9) | ranking(0.03, 0.02, 0.04)
    overlapping, separate = validation(0.7) | ranking(0.05, 0.039, 0.07), validation(0.6) | ranking(0.06, 0.05, 0.07)
    warnings = collect_warnings(config, (0, start), (3, overlapping), (6, separate), (9, separate))
    assert list(warnings) == [6]
    assert "the action-ranking error is 6.0 % (before training 3.0 %, chance 50 %), although" in warnings[6]
    worse = validation(0.95) | ranking(0.06, 0.05, 0.07)
    assert "although" not in collect_warnings(config, (0, start), (3, worse))[3]


def test_warning_is_logged_and_not_repeated_after_a_resume(config: Config, reporter) -> None:
    for step, one_step in ((0, 0.8), (3, 0.85), (6, 0.86)):  # each as in a new process
        trackers = open_trackers(config, Path(config.run_dir), run_id="a", first_step=step)
        with DivergenceWarningLog(config, reporter, first_step=step, trackers=trackers) as log:
            log.write("validation", step, validation(one_step))
    (warning,) = (row for row in read_metrics_log(log.path) if row["kind"] == "warning")
    assert warning["step"] == 3
    assert reporter.notes == [f"Warning: {warning['text']}"]
