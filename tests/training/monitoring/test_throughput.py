"""Throughput metrics equal their definitions."""

import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from vjepa2_ac.config import ModelSizes
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.data.clips.clip_reader import no_clips
from vjepa2_ac.distributed import device
from vjepa2_ac.distributed.device import matmul_speed
from vjepa2_ac.episode import POSE_WIDTHS, Batch
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.training.cost.flops import clip_flops
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.monitoring import MEASURED, Throughput, TimedBatches, Update, peak_memory_gb

CPU = torch.device("cpu")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A clock that only a test advances."""
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    return now


def test_update_to_weight_is_of_all_tensors_together() -> None:
    one, other = torch.full((2, 2), 3.0), torch.tensor([8.0])  # norm: sqrt(36 + 64) = 10
    update = Update([one, other])
    one += 0.3
    other += 0.8
    assert update.to_weight() == pytest.approx(1.0 / 10.0)


def test_weights_that_stay_have_no_update_and_weights_of_zero_no_ratio() -> None:
    assert Update([torch.ones(3)]).to_weight() == 0.0
    zeros = torch.zeros(3)
    update = Update([zeros])
    zeros += 1
    assert math.isnan(update.to_weight())


def test_waiting_for_the_loader_is_counted_and_work_in_between_is_not(clock: list[float]) -> None:
    def loader() -> Iterator[Batch]:
        while True:
            clock[0] += 2.0
            yield no_clips(2, POSE_WIDTHS, bytes_fetched=0)

    batches = TimedBatches(loader())
    next(batches)
    clock[0] += 50.0
    next(batches)
    assert batches.waited_s == 4.0


def test_throughput_counts_clips_tokens_and_flops_per_second() -> None:
    config = parse_config({"run_dir": "r", "data": {"path": "d", "frames": 8}, "model": {"base": "b"}}, where="test")
    sizes, speed = ModelSizes(), matmul_speed(CPU, torch.bfloat16)
    throughput = Throughput.of(config, sizes, CPU, processes=2)
    metrics = throughput.metrics(clips=12.0, seconds=4.0, waited_s=1.0)
    assert metrics["samples_per_second"] == 3.0
    assert metrics["tokens_per_second"] == 3.0 * 8 * 256
    assert metrics["data_wait_share"] == 0.25
    assert metrics["mfu"] == pytest.approx(3.0 * clip_flops(config, sizes).total / (2 * speed))
    assert metrics.keys() == MEASURED


def test_the_ceiling_is_the_best_product_that_was_timed(clock: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = iter([9.0, 0.1, 0.05, 0.08, 0.5])  # the first one is not counted

    def product(*factors: torch.Tensor) -> torch.Tensor:
        clock[0] += next(seconds)
        return factors[0]

    monkeypatch.setattr(torch, "mm", product)
    speed = matmul_speed.__wrapped__(CPU, torch.float32)
    assert speed == pytest.approx(2 * device._CPU_MATRIX**3 / 0.05)


def test_measuring_the_ceiling_leaves_the_random_numbers_alone() -> None:
    before = torch.get_rng_state()
    matmul_speed.__wrapped__(CPU, torch.float32)
    assert torch.equal(before, torch.get_rng_state())


def test_peak_memory_grows_with_what_is_held() -> None:
    before = peak_memory_gb(CPU)
    held = torch.ones(round((before + 0.2) * 1e9 / 4))  # touched, so that it is resident
    assert peak_memory_gb(CPU) >= held.nbytes / 1e9 - 0.01


def test_every_row_of_training_says_how_the_run_and_the_machine_are(make_config, reporter) -> None:
    stepped: dict[int, dict[str, float]] = {}
    reporter.stepped = lambda step, metrics: stepped.update({step: metrics})
    folder = train(make_config(training__steps=3, training__log_every=2, training__schedule="constant"), reporter)
    rows = [row for row in read_metrics_log(folder / "metrics.jsonl") if row["kind"] == "train"]
    assert [row["step"] for row in rows] == [2, 3]
    for row in rows:
        assert row.keys() >= MEASURED | {"loss", "grad_norm", "learning_rate", "update_to_weight"}
        assert 0 < row["update_to_weight"] < 1
        assert 0 < row["data_wait_share"] < 1
        assert row["mfu"] > 0
    assert "update_to_weight" not in stepped[1], "it needs a copy of the weights"
    assert sum("ceiling for mfu" in note for note in reporter.notes) == 1


def test_a_tracker_that_is_not_there_stops_a_run_before_its_first_step(make_config, reporter, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    config = make_config(tracking__wandb="offline")
    with pytest.raises(InputError, match="wandb is not installed"):
        train(config, reporter)
    assert not Path(config.run_dir).exists()
