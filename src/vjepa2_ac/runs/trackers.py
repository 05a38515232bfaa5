"""Trackers for a run's curves: TensorBoard, Weights & Biases and trackio, as the config asks, by Accelerate's classes.

A tracker has a thread of its own: one that cannot be opened, fails or hangs is disabled with one warning, and training
continues without it. Only a library that is not installed is an error, before the first step. `metrics.jsonl`
(`runs.metrics_log`) has all metrics regardless of trackers. A resumed run, on whatever machine, continues the same W&B
or trackio run.
"""

from __future__ import annotations

import importlib.util
import logging
import math
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
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

PATIENCE_S = 60.0  # after which a warning says that a tracker does not answer
CLOSING_S = 30.0  # that the end of a run waits for all of them
MOST_ROWS = 10_000  # that wait for a tracker: some 15 MB
MOST_IMAGES = 8  # likewise

Image = UInt8[np.ndarray, "height width 3"]
Opening = Callable[[], Any]
"""Makes a tracker (accelerate.tracking.GeneralTracker), whose methods may raise anything, and take any time."""


class Trackers:
    """The working trackers of a run.

    Args:
        openings: Functions that make a tracker, by its display name.
    """

    def __init__(self, openings: Mapping[str, Opening]) -> None:
        self._threads = [_Thread(name, opening) for name, opening in openings.items()]

    def log(self, kind: str, step: int, metrics: Mapping[str, Any]) -> None:
        """Log the numbers of a row; lists, such as errors by horizon, number by number from 1."""
        numbers = {f"{kind}/{key}": value for key, value in _numbers(metrics).items()}
        for thread in self._threads:
            thread.put(lambda tracker: tracker.log(numbers, step=step), MOST_ROWS)

    def log_image(self, kind: str, name: str, step: int, image: Image) -> None:
        """Log an image, which nobody changes any more."""
        for thread in self._threads:
            thread.put(lambda tracker: tracker.log_images({f"{kind}/{name}": image[None]}, step=step), MOST_IMAGES)

    def close(self) -> None:
        """Close all; a second call does nothing."""
        threads, self._threads = self._threads, []
        until_s = time.monotonic() + CLOSING_S
        for thread in threads:
            thread.rows.put(None)
        for thread in threads:
            thread.wait(max(0.0, until_s - time.monotonic()))


class _Thread:
    """A tracker in a thread, which makes it, sends it rows and closes it; problems are warned of once."""

    def __init__(self, name: str, opening: Opening) -> None:
        self._name, self._opening = name, opening
        self.rows: queue.SimpleQueue[Callable[[Any], None] | None] = queue.SimpleQueue()  # None: the end
        self._doing, self._since_s = "cannot be opened", time.monotonic()  # the current call, if it does not end
        self._warned, self._dropped = False, 0
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def put(self, send: Callable[[Any], None], most: int) -> None:
        """Queue what is to be sent, unless so many rows wait already."""
        if not self._thread.is_alive():
            return
        if self.rows.qsize() < most:
            self.rows.put(send)
        else:
            self._dropped += 1
        if time.monotonic() - self._since_s > PATIENCE_S:
            self._warn(f"no answer within {PATIENCE_S:g} s", "its metrics wait")

    def wait(self, within_s: float) -> None:
        """Wait until it is closed, at most for the rest of `CLOSING_S`."""
        self._thread.join(within_s)
        if self._thread.is_alive():
            self._warn(f"no answer within {CLOSING_S:g} s", "its last metrics may be missing there")
        if self._dropped:
            logger.warning("%s was too slow for %d rows, which are missing there", self._name, self._dropped)

    def _work(self) -> None:
        after = "going on without it"
        try:
            tracker = self._opening()
            tracker.start()
            self._since_s = math.inf
            while (send := self.rows.get()) is not None:
                self._doing, self._since_s = "failed", time.monotonic()
                send(tracker)
                self._since_s = math.inf
            after = "its last metrics may be missing there"
            self._doing, self._since_s = "did not close", time.monotonic()
            tracker.finish()
        except BaseException as error:  # also SystemExit and the like: a tracker never stops training
            first_line = str(error).strip().partition("\n")[0]
            self._warn(f"{type(error).__name__}: {first_line}".removesuffix(": "), after)

    def _warn(self, reason: str, after: str) -> None:
        if not self._warned:
            self._warned = True
            logger.warning("%s %s (%s); %s", self._name, self._doing, reason, after)


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
