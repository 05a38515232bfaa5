"""Trackers receive the metrics and resume the same run; a failing tracker only causes a warning."""

import importlib.util
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.runs.metrics_log import Trackers, open_trackers


@pytest.fixture(autouse=True)
def _isolated_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Prevent trackers from writing into the user's home, sending telemetry, or using the user's account."""
    for name in ("HOME", "WANDB_CACHE_DIR", "WANDB_CONFIG_DIR", "WANDB_DATA_DIR", "TRACKIO_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    for name in ("WANDB_API_KEY", "WANDB_DIR", "WANDB_MODE", "WANDB_RUN_ID"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("WANDB_PROJECT", "arms")
    monkeypatch.setenv("WANDB_ERROR_REPORTING", "false")
    monkeypatch.setenv("WANDB_SILENT", "true")


def run_config(folder: Path, **tracking: Any) -> Config:
    values = {
        "run_dir": str(folder), "data": {"path": "d"}, "model": {"base": "b"},
        "tracking": {"tensorboard": False, **tracking},
    }  # fmt: skip
    return parse_config(values, where="test")


class RecordingTracker:
    """A tracker that records its input, or raises."""

    def __init__(self, fails_in: str = "") -> None:
        self.rows: list[tuple[int, dict[str, float]]] = []
        self.images: list[tuple[int, str, np.ndarray]] = []
        self.fails_in = fails_in
        self.closed = 0

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        if self.fails_in == "log":
            raise ConnectionError("the network\nis away")
        self.rows.append((step, dict(metrics)))

    def log_images(self, images: Mapping[str, np.ndarray], step: int) -> None:
        if self.fails_in == "log":
            raise ConnectionError("the network\nis away")
        self.images += [(step, name, image[0]) for name, image in images.items()]

    def start(self) -> None:
        pass

    def finish(self) -> None:
        self.closed += 1
        if self.fails_in == "finish":
            raise ConnectionError("the network is away")


def raise_error() -> RecordingTracker:
    raise ConnectionError("the network is away")


def exit_process() -> RecordingTracker:
    raise SystemExit(3)


def warnings_in(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_trackers_receive_metrics_by_name_and_lists_as_numbers() -> None:
    recorder = RecordingTracker()
    trackers = Trackers({"one": lambda: recorder})
    trackers.log("validation", 7, {"error": 0.5, "by_horizon": [1.0, 2.0], "nothing": float("nan"), "text": "no"})
    trackers.close()
    assert recorder.rows == [
        (7, {"validation/error": 0.5, "validation/by_horizon/1": 1.0, "validation/by_horizon/2": 2.0})
    ]


@pytest.mark.parametrize("opening", [raise_error, exit_process])
def test_tracker_that_cannot_be_opened_causes_one_warning(caplog, opening: Callable[[], RecordingTracker]) -> None:
    recorder = RecordingTracker()
    trackers = Trackers({"bad": opening, "good": lambda: recorder})
    trackers.log("train", 1, {"loss": 0.5})
    trackers.close()
    assert len(recorder.rows) == recorder.closed == 1
    assert [text.split(" (")[0] for text in warnings_in(caplog)] == ["bad cannot be opened"]


@pytest.mark.parametrize("fails_in", ["log", "finish"])
def test_tracker_that_fails_later_causes_one_warning(caplog, fails_in: str) -> None:
    bad, good = RecordingTracker(fails_in), RecordingTracker()
    trackers = Trackers({"bad": lambda: bad, "good": lambda: good})
    for step in (1, 2):
        trackers.log("train", step, {"loss": 0.5})
    trackers.close()
    trackers.close()
    assert len(good.rows) == 2
    assert good.closed == 1
    (warning,) = warnings_in(caplog)
    assert warning.startswith("bad ")
    assert "ConnectionError: the network" in warning
    assert "\n" not in warning


def test_tensorboard_receives_metrics_and_drops_repeated_steps(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    config = run_config(tmp_path, tensorboard=True)
    for first_step, steps in ((0, (1, 2, 3)), (1, (2,))):
        trackers = open_trackers(config, tmp_path, run_id="x", first_step=first_step)
        for step in steps:
            trackers.log("train", step, {"loss": 0.25 * step})
            trackers.log_image("validation", "imagined", step, np.zeros((4, 5, 3), dtype=np.uint8))
        trackers.close()
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [(event.step, event.value) for event in events.Scalars("train/loss")] == [(1, 0.25), (2, 0.5)]
    assert [(event.step, event.height, event.width) for event in events.Images("validation/imagined")] == [
        (1, 4, 5), (2, 4, 5),
    ]  # fmt: skip


def test_run_without_tensorboard_prints_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "tensorboard" else find(name))
    trackers = open_trackers(run_config(tmp_path, tensorboard=True), tmp_path, run_id="x", first_step=0)
    trackers.log("train", 1, {"loss": 0.5})
    (line,) = warnings_in(caplog)
    assert "TensorBoard is not installed" in line
    assert "[tensorboard]" in line


def test_resumed_run_continues_the_same_offline_wandb_run(tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    config = run_config(tmp_path, wandb="offline")
    for first_step in (0, 1):
        trackers = open_trackers(config, tmp_path, run_id="abc123", first_step=first_step)
        trackers.log("train", first_step + 1, {"loss": 0.25})
        trackers.close()
    files = list((tmp_path / "wandb").glob("offline-run-*-abc123/run-abc123.wandb"))
    content = b"".join(path.read_bytes() for path in files)
    assert content.count(b"train/loss") >= 2
    for text in (b"arms", b"training.learning_rate", b"adapter.rank"):
        assert text in content


def test_resumed_run_continues_the_same_trackio_run(tmp_path: Path) -> None:
    trackio = pytest.importorskip("trackio")
    config = run_config(tmp_path, trackio=True)
    for first_step in (0, 1):
        trackers = open_trackers(config, tmp_path, run_id="abc123", first_step=first_step)
        trackers.log("train", first_step + 1, {"loss": 0.25})
        trackers.close()
    (run,) = trackio.Api().runs("arms")
    assert run.name == "abc123"
