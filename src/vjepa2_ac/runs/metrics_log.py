"""The metrics log of a run: metrics.jsonl, and the trackers.

Rows that cannot be written to metrics.jsonl, for example on a full disk, are kept in memory and retried with each
further row. A checkpoint is then due immediately, and rows must be on the disk before it is complete. If they still
cannot be written, the run ends with an error.

Trackers are TensorBoard, Weights & Biases and trackio, through Accelerate's classes. These libraries write in separate
threads or processes. A tracker that cannot be opened or that fails is disabled with one warning. Only a library that
is not installed is an error, before the first step. A resumed run continues the same W&B or trackio run.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import math
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.config import Config, TrackingConfig
from vjepa2_ac.config.loading import config_as_flat_dict
from vjepa2_ac.errors import InputError, pip_install
from vjepa2_ac.registry import TRACKERS
from vjepa2_ac.runs.folder import METRICS, TENSORBOARD
from vjepa2_ac.storage import read_small_file, translate_write_errors, write_atomically
from vjepa2_ac.storage.structured import finite_or_none, parse_json_object

logger = logging.getLogger(__name__)

WARNING = "warning"  # kind of a row in metrics.jsonl with a `text` instead of metrics
STALLED_S = 60.0

_MAX_BYTES = 1 << 28

Image = UInt8[np.ndarray, "height width 3"]


class MetricsLog:
    """A log that appends rows to `metrics.jsonl`, one JSON object per line, and sends them to trackers.

    Args:
        run_dir: The run folder.
        first_step: Rows after this step are removed, because the run repeats these steps.
        trackers: The trackers, which are closed with the log; None for no trackers.

    Raises:
        InputError: The file cannot be written.
    """

    def __init__(self, run_dir: Path, *, first_step: int, trackers: Trackers | None = None) -> None:
        self.path = run_dir / METRICS
        rows = [row for row in read_metrics_log(self.path) if row["step"] <= first_step] if first_step > 0 else []
        with translate_write_errors(self.path):
            write_atomically(self.path, "".join(json.dumps(row) + "\n" for row in rows).encode())
            self._handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW)
        self._unwritten = b""  # rows that could not be written yet; the first may be partly written
        self._trackers = trackers or Trackers({})

    def write(self, kind: str, step: int, metrics: Mapping[str, Any]) -> None:
        """Append a row: its kind (train, validation), its optimizer step, and metrics (numbers or lists of numbers)."""
        plain = {key: finite_or_none(value) if isinstance(value, float) else value for key, value in metrics.items()}
        row = {"kind": kind, "step": step, **plain}
        self._unwritten += (json.dumps(row) + "\n").encode()
        self._write()
        self._trackers.log(kind, step, metrics)

    def log_image(self, kind: str, name: str, step: int, image: Image) -> None:
        """Send an image to the trackers; metrics.jsonl does not contain images."""
        self._trackers.log_image(kind, name, step, image)

    @property
    def has_unwritten_rows(self) -> bool:
        """Whether some rows could not be written yet."""
        return bool(self._unwritten)

    @contextmanager
    def flush_before_checkpoint(self) -> Iterator[None]:
        """Sync the rows to the disk before the block saves a checkpoint, because the run resumes after these rows.

        The block runs in any case, because losing a checkpoint is worse than losing a row. It may also free disk space,
        by removing an older checkpoint.

        Raises:
            InputError: Rows can be written neither before nor after the block.
        """
        error = self._write(sync=True)
        yield
        if error and self._unwritten:
            error = self._write(sync=True)
        if error:  # after a failed fsync the system may have discarded the data
            problem = f"the latest metrics cannot be written ({error.strerror or error}), and are lost"
            fix = "Free disk space, then run the same command again to resume"
            raise InputError(where=str(self.path), found=problem, fix=f"The checkpoint of this step is saved. {fix}")

    def _write(self, *, sync: bool = False) -> OSError | None:
        """Write the unwritten rows, and with `sync` flush them to the disk; return the error if this fails."""
        if not self._unwritten and not sync:
            return None
        try:
            with warn_if_stalled(self.path):
                while self._unwritten:
                    self._unwritten = self._unwritten[os.write(self._handle, self._unwritten) :]
                if sync:
                    os.fsync(self._handle)
        except OSError as error:
            return error
        return None

    def __enter__(self) -> MetricsLog:
        """Return the metrics log, open."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file and the trackers."""
        self._write()
        os.close(self._handle)
        self._trackers.close()


def read_metrics_log(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of a metrics.jsonl; an incomplete last line of a killed process is skipped.

    Raises:
        InputError: The file is too large.
    """
    if not path.exists():
        return
    for line in read_small_file(path, _MAX_BYTES).decode(errors="replace").splitlines():
        try:
            row = parse_json_object(line, where=str(path))
        except InputError:
            row = {}
        if type(row.get("step")) is int and isinstance(row.get("kind"), str):
            yield row
        else:
            logger.warning("%s: a line is incomplete or not a row of metrics; it is skipped", path)


def read_warnings(path: Path) -> list[str]:
    """Return the warnings of a run, from its metrics.jsonl."""
    rows = (row for row in read_metrics_log(path) if row.get("kind") == WARNING)
    return [row["text"] for row in rows if isinstance(row.get("text"), str)]


@contextmanager
def warn_if_stalled(path: Path) -> Iterator[None]:
    """Warn if the block, which writes a file, takes longer than a minute.

    A network disk may block for minutes. Without a warning, training would seem to hang.
    """
    text = "%s: writing this file takes more than %g s; training waits for the disk"
    timer = threading.Timer(STALLED_S, logger.warning, (text, path, STALLED_S))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


# ---- trackers ----

TrackerFactory = Callable[[], Any]
"""Creates a tracker (accelerate.tracking.GeneralTracker); its methods may raise any error."""


class Trackers:
    """The working trackers of a run.

    Args:
        factories: Display name -> function that creates the tracker.
    """

    def __init__(self, factories: Mapping[str, TrackerFactory]) -> None:
        self._open: dict[str, Any] = {}
        for name, factory in factories.items():
            with self._disable_on_error(name, "cannot be opened", "training continues without it"):
                tracker = factory()
                tracker.start()
                self._open[name] = tracker

    def log(self, kind: str, step: int, metrics: Mapping[str, Any]) -> None:
        """Log the numbers of a row; each number of a list, such as errors by horizon, separately and counted from 1."""
        numbers = {f"{kind}/{key}": value for key, value in _flatten_numbers(metrics).items()}
        self._for_each(lambda tracker: tracker.log(numbers, step=step))

    def log_image(self, kind: str, name: str, step: int, image: Image) -> None:
        """Log an image."""
        self._for_each(lambda tracker: tracker.log_images({f"{kind}/{name}": image[None]}, step=step))

    def close(self) -> None:
        """Close all trackers; a second call does nothing."""
        for name, tracker in self._open.items():
            with self._disable_on_error(name, "did not close", "its last metrics may be missing there"):
                tracker.finish()
        self._open = {}

    def _for_each(self, send: Callable[[Any], None]) -> None:
        for name, tracker in list(self._open.items()):
            with self._disable_on_error(name, "failed", "training continues without it"):
                send(tracker)

    @contextmanager
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
        InputError: A requested library is not installed.
    """
    requested = {
        "wandb": (tracking.wandb != "disabled", pip_install("wandb"), "disabled"),
        "trackio": (tracking.trackio, pip_install("trackio"), "false"),
    }
    for library, (is_requested, install, off) in requested.items():
        if is_requested and importlib.util.find_spec(library) is None:
            problem, fix = f"enabled, but {library} is not installed", f"Run {install}, or set tracking.{library}={off}"
            raise InputError(where=f"tracking.{library}", found=problem, fix=fix)


def open_trackers(config: Config, folder: Path, *, run_id: str, first_step: int) -> Trackers:
    """Open the trackers of a config; a tracker that cannot be opened is disabled with a warning.

    Args:
        config: The config of the run.
        folder: The run folder, where TensorBoard and W&B write.
        run_id: The id of the run, also used by the trackers.
        first_step: Number of completed steps; TensorBoard drops later rows, because the run repeats these steps.
    """
    tracking = config.tracking
    factories: dict[str, TrackerFactory] = {}
    if tracking.tensorboard and importlib.util.find_spec("tensorboard") is None:
        message = (
            "TensorBoard is not installed, so no event files are written. metrics.jsonl contains all metrics. To"
            " install TensorBoard, run %s"
        )
        logger.warning(message, pip_install("tensorboard"))
    elif tracking.tensorboard:
        factories["TensorBoard"] = lambda: _open_tensorboard(folder, first_step)
    if tracking.wandb != "disabled":
        factories["Weights & Biases"] = lambda: _open_wandb(config, folder, run_id)
    if tracking.trackio:
        factories["trackio"] = lambda: _open_trackio(config, run_id)
    for name, options in tracking.others.items():
        factories[name] = partial(TRACKERS.find(name), folder, run_id, **TRACKERS.options(name, options))
    return Trackers(factories)


def _project_name() -> str:
    """Return the project name for Weights & Biases and trackio."""
    return os.environ.get("WANDB_PROJECT", "vjepa2-ac")


def _open_tensorboard(folder: Path, first_step: int) -> Any:
    from accelerate.tracking import TensorBoardTracker

    tracker = TensorBoardTracker(TENSORBOARD, folder, purge_step=first_step + 1)
    tracker.log_images = partial(tracker.log_images, dataformats="NHWC")
    return tracker


def _open_wandb(config: Config, folder: Path, run_id: str) -> Any:
    """Return a W&B tracker. W&B ignores rows of steps it already has; a resumed run repeats exactly these rows."""
    import wandb
    from accelerate.tracking import WandBTracker

    # Console output is not captured, because it contains the progress bar. Timeouts limit the delay of training.
    return WandBTracker(
        _project_name(),
        id=run_id,
        name=folder.resolve().name,
        resume="allow",
        mode=config.tracking.wandb,
        dir=os.environ.get("WANDB_DIR") or str(folder),
        config=config_as_flat_dict(config),
        allow_val_change=True,
        settings=wandb.Settings(init_timeout=20.0, login_timeout=30.0, finish_timeout=20.0, console="off"),
    )


def _open_trackio(config: Config, run_id: str) -> Any:
    """Return a trackio tracker. trackio identifies a run by its name, which is therefore the run's id."""
    import trackio
    from accelerate.tracking import TrackioTracker

    class WithImages(TrackioTracker):  # type: ignore[misc]  # untyped
        def log_images(self, values: Mapping[str, Any], step: int) -> None:
            self.log({name: trackio.Image(images[0]) for name, images in values.items()}, step=step)

    plain = config_as_flat_dict(config)
    return WithImages(_project_name(), name=run_id, resume="allow", config=plain, embed=False)


def _flatten_numbers(metrics: Mapping[str, Any]) -> dict[str, float]:
    numbers: dict[str, float] = {}
    for key, value in metrics.items():
        values = {f"{key}/{n}": v for n, v in enumerate(value, start=1)} if isinstance(value, list) else {key: value}
        numbers |= {name: float(v) for name, v in values.items() if isinstance(v, int | float) and math.isfinite(v)}
    return numbers
