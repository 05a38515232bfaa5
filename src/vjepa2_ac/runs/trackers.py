"""Trackers for a run's curves: TensorBoard, Weights & Biases and trackio, as the config asks.

A tracker has a thread of its own (`tracker_thread`): one that cannot be opened, fails or hangs is disabled with one
warning, and training continues without it. Only a library that is not installed is an error, before the first step.
`metrics.jsonl` (`runs.metrics_log`) has all metrics regardless of trackers. A resumed run, on whatever machine,
continues the same W&B or trackio run.
"""

from __future__ import annotations

import importlib.util
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vjepa2_ac.config import Config, TrackingConfig
from vjepa2_ac.config.loading import config_as_flat_dict
from vjepa2_ac.errors import InputError, pip_install
from vjepa2_ac.runs.folder import TENSORBOARD
from vjepa2_ac.runs.tracker_thread import Image, Opening, TrackerThread

PATIENCE_S = 60.0  # after which a warning says that a tracker does not answer
CLOSING_S = 30.0  # that the end of a run waits for all of them


class Trackers:
    """The working trackers of a run.

    Args:
        openings: Functions that open a tracker, by its display name.
        opening_s: After which a warning says that one does not answer; training does not wait for it.
        closing_s: Longest wait at the end, for all of them.
    """

    def __init__(
        self, openings: Mapping[str, Opening], *, opening_s: float = PATIENCE_S, closing_s: float = CLOSING_S
    ) -> None:
        self._closing_s = closing_s
        self._threads = [TrackerThread(name, opening, patience_s=opening_s) for name, opening in openings.items()]

    def log(self, kind: str, step: int, metrics: Mapping[str, Any]) -> None:
        """Log the numbers of a row; lists, such as errors by horizon, number by number from 1."""
        numbers = {f"{kind}/{key}": value for key, value in _numbers(metrics).items()}
        for thread in self._threads:
            thread.log(numbers, step)

    def log_image(self, kind: str, name: str, step: int, image: Image) -> None:
        """Log an image, which nobody changes any more."""
        for thread in self._threads:
            thread.log_image(f"{kind}/{name}", image, step)

    def close(self) -> None:
        """Close all; a second call does nothing."""
        threads, self._threads = self._threads, []
        until_s = time.monotonic() + self._closing_s
        for thread in threads:
            thread.end()
        for thread in threads:
            thread.wait(max(0.0, until_s - time.monotonic()), self._closing_s)


def require_installed(tracking: TrackingConfig) -> None:
    """Check that the libraries of the trackers are installed.

    Raises:
        InputError: A requested one is not installed.
    """
    asked = {
        "tensorboard": (tracking.tensorboard, pip_install(), "false"),
        "wandb": (tracking.wandb != "disabled", pip_install("wandb"), "disabled"),
        "trackio": (tracking.trackio, pip_install("trackio"), "false"),
    }
    for library, (is_asked, install, off) in asked.items():
        if is_asked and importlib.util.find_spec(library) is None:
            found, fix = f"asked for, but {library} is not installed", f"Run {install}, or set tracking.{library}={off}"
            raise InputError(where=f"tracking.{library}", found=found, fix=fix)


def open_trackers(config: Config, folder: Path, *, run_id: str, first_step: int) -> Trackers:
    """Open the trackers of a config; one that cannot be opened is disabled with a warning.

    Args:
        config: The run.
        folder: Its folder, where TensorBoard and W&B write.
        run_id: The run's permanent name, there, too.
        first_step: Completed steps; TensorBoard drops rows after it, whose steps are repeated.
    """
    tracking = config.tracking
    openings: dict[str, Opening] = {}
    if tracking.tensorboard:
        openings["TensorBoard"] = lambda: _TensorBoard(folder / TENSORBOARD, first_step)
    if tracking.wandb != "disabled":
        openings["Weights & Biases"] = lambda: _wandb_run(config, folder, run_id)
    if tracking.trackio:
        openings["trackio"] = lambda: _trackio_run(config, run_id)
    return Trackers(openings)


class _TensorBoard:
    def __init__(self, folder: Path, first_step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer: Any = SummaryWriter(str(folder), purge_step=first_step + 1)

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)

    def log_image(self, name: str, image: Image, step: int) -> None:
        self._writer.add_image(name, image, step, dataformats="HWC")

    def close(self) -> None:
        self._writer.close()


class _OnlineRun:
    """A run of W&B or trackio, whose methods are alike.

    W&B ignores rows of steps that it has already: a resumed run repeats the same metrics.
    """

    def __init__(self, run: Any, as_image: Callable[[Image], Any]) -> None:
        self._run, self._as_image = run, as_image

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        self._run.log(dict(metrics), step=step)

    def log_image(self, name: str, image: Image, step: int) -> None:
        self._run.log({name: self._as_image(image)}, step=step)

    def close(self) -> None:
        self._run.finish()


def _wandb_run(config: Config, folder: Path, run_id: str) -> _OnlineRun:
    import wandb

    # Output is not captured: it would contain the console's progress bar. Times are bounded where W&B can.
    bounds: dict[str, Any] = {"init_timeout": 20.0, "login_timeout": 30.0, "finish_timeout": 20.0, "console": "off"}
    known = getattr(wandb.Settings, "model_fields", {})
    run = wandb.init(
        project=config.tracking.project,
        id=run_id,
        name=folder.resolve().name,
        resume="allow",
        mode=config.tracking.wandb,
        dir=os.environ.get("WANDB_DIR") or str(folder),
        config=config_as_flat_dict(config),
        allow_val_change=True,
        settings=wandb.Settings(**{name: value for name, value in bounds.items() if name in known}),
    )
    return _OnlineRun(run, lambda image: wandb.Image(image))  # looked up late: an old version may have none


def _trackio_run(config: Config, run_id: str) -> _OnlineRun:
    """Open trackio, which identifies a run by its name: that is therefore the run's id."""
    import trackio

    plain, project = config_as_flat_dict(config), config.tracking.project
    run = trackio.init(project=project, name=run_id, resume="allow", config=plain, embed=False)
    return _OnlineRun(run, lambda image: trackio.Image(image))


def _numbers(metrics: Mapping[str, Any]) -> dict[str, float]:
    numbers: dict[str, float] = {}
    for key, value in metrics.items():
        values = {f"{key}/{n}": v for n, v in enumerate(value, start=1)} if isinstance(value, list) else {key: value}
        numbers |= {name: float(v) for name, v in values.items() if isinstance(v, int | float) and math.isfinite(v)}
    return numbers
