"""Trackers for a run's curves: TensorBoard, Weights & Biases and trackio, as the config asks, by Accelerate's classes.

These libraries write in threads or processes of their own. A tracker that cannot be opened or that fails is disabled
with one warning, and training continues without it. Only a library that is not installed is an error, before the first
step. `metrics.jsonl` (`runs.metrics_log`) has all metrics regardless of trackers. A resumed run, on whatever machine,
continues the same W&B or trackio run.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import math
import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.config import Config, TrackingConfig
from vjepa2_ac.config.loading import config_as_flat_dict
from vjepa2_ac.errors import InputError, pip_install
from vjepa2_ac.registry import TRACKERS
from vjepa2_ac.runs.folder import TENSORBOARD

logger = logging.getLogger(__name__)

Image = UInt8[np.ndarray, "height width 3"]
Opening = Callable[[], Any]
"""Makes a tracker (accelerate.tracking.GeneralTracker), whose methods may raise anything."""


class Trackers:
    """The working trackers of a run.

    Args:
        openings: Functions that make a tracker, by its display name.
    """

    def __init__(self, openings: Mapping[str, Opening]) -> None:
        self._open: dict[str, Any] = {}
        for name, opening in openings.items():
            with self._disable_on_error(name, "cannot be opened", "training continues without it"):
                tracker = opening()
                tracker.start()
                self._open[name] = tracker

    def log(self, kind: str, step: int, metrics: Mapping[str, Any]) -> None:
        """Log the numbers of a row; lists, such as errors by horizon, number by number from 1."""
        numbers = {f"{kind}/{key}": value for key, value in _numbers(metrics).items()}
        self._for_each(lambda tracker: tracker.log(numbers, step=step))

    def log_image(self, kind: str, name: str, step: int, image: Image) -> None:
        """Log an image."""
        self._for_each(lambda tracker: tracker.log_images({f"{kind}/{name}": image[None]}, step=step))

    def close(self) -> None:
        """Close all; a second call does nothing."""
        for name, tracker in self._open.items():
            with self._disable_on_error(name, "did not close", "its last metrics may be missing there"):
                tracker.finish()
        self._open = {}

    def _for_each(self, send: Callable[[Any], None]) -> None:
        for name, tracker in list(self._open.items()):
            with self._disable_on_error(name, "failed", "training continues without it"):
                send(tracker)

    @contextlib.contextmanager
    def _disable_on_error(self, name: str, problem: str, consequence: str) -> Iterator[None]:
        try:
            yield
        except (Exception, SystemExit) as error:  # a tracker never stops training
            reason = f"{type(error).__name__}: {next(iter(str(error).strip().splitlines()), '')}".removesuffix(": ")
            logger.warning("%s %s (%s); %s", name, problem, reason, consequence)
            self._open = {other: tracker for other, tracker in self._open.items() if other != name}


def require_installed(tracking: TrackingConfig) -> None:
    """Check that the libraries of the trackers are installed.

    Raises:
        InputError: A requested one is not installed.
    """
    asked = {
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
    if tracking.tensorboard and importlib.util.find_spec("tensorboard") is None:
        missing = (
            "TensorBoard is not installed: no event files, but metrics.jsonl has every number. To install it, run %s"
        )
        logger.warning(missing, pip_install("tensorboard"))
    elif tracking.tensorboard:
        openings["TensorBoard"] = lambda: _tensorboard(folder, first_step)
    if tracking.wandb != "disabled":
        openings["Weights & Biases"] = lambda: _wandb(config, folder, run_id)
    if tracking.trackio:
        openings["trackio"] = lambda: _trackio(config, run_id)
    for name, given in tracking.others.items():
        openings[name] = partial(TRACKERS.find(name), folder, run_id, **TRACKERS.options(name, given))
    return Trackers(openings)


def _tensorboard(folder: Path, first_step: int) -> Any:
    from accelerate.tracking import TensorBoardTracker

    tracker = TensorBoardTracker(TENSORBOARD, folder, purge_step=first_step + 1)
    tracker.log_images = partial(tracker.log_images, dataformats="NHWC")
    return tracker


def _wandb(config: Config, folder: Path, run_id: str) -> Any:
    """Return a tracker of W&B, which ignores rows of steps that it has already: a resumed run repeats the same."""
    import wandb
    from accelerate.tracking import WandBTracker

    # Output is not captured: it would contain the console's progress bar. Times are bounded.
    return WandBTracker(
        config.tracking.project,
        id=run_id,
        name=folder.resolve().name,
        resume="allow",
        mode=config.tracking.wandb,
        dir=os.environ.get("WANDB_DIR") or str(folder),
        config=config_as_flat_dict(config),
        allow_val_change=True,
        settings=wandb.Settings(init_timeout=20.0, login_timeout=30.0, finish_timeout=20.0, console="off"),
    )


def _trackio(config: Config, run_id: str) -> Any:
    """Return a tracker of trackio, which identifies a run by its name: that is therefore the run's id."""
    import trackio
    from accelerate.tracking import TrackioTracker

    class WithImages(TrackioTracker):  # type: ignore[misc]  # untyped
        def log_images(self, values: Mapping[str, Any], step: int) -> None:
            self.log({name: trackio.Image(images[0]) for name, images in values.items()}, step=step)

    plain = config_as_flat_dict(config)
    return WithImages(config.tracking.project, name=run_id, resume="allow", config=plain, embed=False)


def _numbers(metrics: Mapping[str, Any]) -> dict[str, float]:
    numbers: dict[str, float] = {}
    for key, value in metrics.items():
        values = {f"{key}/{n}": v for n, v in enumerate(value, start=1)} if isinstance(value, list) else {key: value}
        numbers |= {name: float(v) for name, v in values.items() if isinstance(v, int | float) and math.isfinite(v)}
    return numbers
