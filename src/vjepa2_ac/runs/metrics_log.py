"""The metrics log of a run: rows go to metrics.jsonl always, and to its trackers.

`metrics.jsonl` is the run's own record. Where it cannot be written, on a full disk for example, rows wait, and are
retried with each further row. They must be on the disk before the run relies on them: at the next checkpoint at the
latest, which is then due at once. If they cannot be written even then, the run ends with an error that says why.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.folder import METRICS
from vjepa2_ac.runs.trackers import Image, Trackers
from vjepa2_ac.storage import read_bounded, user_can_write, write_atomically
from vjepa2_ac.storage.structured import finite_or_none, json_object

logger = logging.getLogger(__name__)

WARNING = "warning"  # kind of a row in metrics.jsonl, which has a `text`
STALLED_S = 60.0

_MOST_BYTES = 1 << 28


class MetricsLog:
    """Appends rows to `metrics.jsonl`, a JSON object per line, and sends them to trackers.

    Args:
        run_dir: The run's folder.
        first_step: Rows after this step belong to a part of the run that is being repeated; they are dropped.
        trackers: Closed with the metrics log; None: there are none.

    Raises:
        InputError: The file cannot be written.
    """

    def __init__(self, run_dir: Path, *, first_step: int, trackers: Trackers | None = None) -> None:
        self.path = run_dir / METRICS
        kept = [row for row in read_metrics_log(self.path) if row["step"] <= first_step] if first_step > 0 else []
        with user_can_write(self.path):
            write_atomically(self.path, "".join(json.dumps(row) + "\n" for row in kept).encode())
            self._handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW)
        self._waiting = b""  # rows that could not be written yet; the first may be partly written
        self._trackers = trackers or Trackers({})

    def write(self, kind: str, step: int, metrics: Mapping[str, Any]) -> None:
        """Append one row: its kind (train, validation), its optimizer step, and metrics (numbers or lists of them)."""
        plain = {key: finite_or_none(one) if isinstance(one, float) else one for key, one in metrics.items()}
        row = {"kind": kind, "step": step, **plain}
        self._waiting += (json.dumps(row) + "\n").encode()
        self._write()
        self._trackers.log(kind, step, metrics)

    def show(self, kind: str, name: str, step: int, image: Image) -> None:
        """Send an image to the trackers; it is no part of metrics.jsonl."""
        self._trackers.log_image(kind, name, step, image)

    @property
    def is_behind(self) -> bool:
        """Whether there are rows that could not be written yet."""
        return bool(self._waiting)

    @contextmanager
    def before_a_checkpoint(self) -> Iterator[None]:
        """Sync the rows to the disk before the block writes a checkpoint, from which the run would resume without them.

        The block runs in any case: hours of work matter more than a row. An older checkpoint that it removes may free
        the space that a row needs.

        Raises:
            InputError: Rows can be written neither before nor after the block.
        """
        error = self._write(sync=True)
        yield
        if error and self._waiting:
            error = self._write(sync=True)
        if error:  # also of a flush, after which the system may have discarded the data
            found = f"the latest metrics cannot be written ({error.strerror or error}), and are lost"
            fix = "Make room on the disk of the run, then resume: the same command goes on"
            raise InputError(where=str(self.path), found=found, fix=f"The checkpoint of this step is written. {fix}")

    def _write(self, *, sync: bool = False) -> OSError | None:
        """Write the rows that wait, and with `sync` wait until the disk has them; return what prevents it."""
        if not self._waiting and not sync:
            return None
        try:
            with warn_if_stalled(self.path):
                while self._waiting:
                    self._waiting = self._waiting[os.write(self._handle, self._waiting) :]
                if sync:
                    os.fsync(self._handle)
        except OSError as error:
            return error
        return None

    def __enter__(self) -> MetricsLog:
        """Return the metrics log, open."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file, and the trackers."""
        self._write()
        os.close(self._handle)
        self._trackers.close()


def read_metrics_log(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of a metrics.jsonl; an incomplete last line of a killed process is skipped.

    Raises:
        InputError: The file is too large to be one.
    """
    if not path.exists():
        return
    for line in read_bounded(path, _MOST_BYTES).decode(errors="replace").splitlines():
        try:
            row = json_object(line, where=str(path))
        except InputError:
            row = {}
        if type(row.get("step")) is int and isinstance(row.get("kind"), str):
            yield row
        else:
            logger.warning("%s: a line is not a row of metrics, or was left by halves; it is dropped", path)


def warnings_of(path: Path) -> list[str]:
    """Return the warnings of a run, from its metrics.jsonl."""
    rows = (row for row in read_metrics_log(path) if row.get("kind") == WARNING)
    return [row["text"] for row in rows if isinstance(row.get("text"), str)]


@contextmanager
def warn_if_stalled(path: Path) -> Iterator[None]:
    """Warn if the block, which writes a file, lasts longer than a minute.

    A network disk may block for minutes, and training has to wait: without a message it would look like one that hangs.
    """
    text = "%s: the disk has not taken it for %g s; training waits for it"
    timer = threading.Timer(STALLED_S, logger.warning, (text, path, STALLED_S))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
