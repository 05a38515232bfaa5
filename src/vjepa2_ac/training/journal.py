"""Where do the figures of a run go? Into metrics.jsonl always, and on to its trackers."""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import read_bounded, write_atomically
from vjepa2_ac.structured import json_object
from vjepa2_ac.training.trackers import Trackers

logger = logging.getLogger(__name__)

_MOST_BYTES = 1 << 28


class Journal:
    """Appends rows to `metrics.jsonl`, a JSON object per line, and hands them on to trackers.

    Args:
        run_dir: The run's folder.
        first_step: Rows after this step are from a part of the run that is now done again; they are dropped.
        trackers: Closed with the journal; None: there are none.
    """

    def __init__(self, run_dir: Path, *, first_step: int, trackers: Trackers | None = None) -> None:
        self.path = run_dir / "metrics.jsonl"
        kept = [row for row in read_journal(self.path) if row["step"] <= first_step] if first_step > 0 else []
        write_atomically(self.path, "".join(json.dumps(row) + "\n" for row in kept).encode())
        self._file = self.path.open("a", encoding="utf-8")
        self._trackers = trackers or Trackers({})

    def write(self, kind: str, step: int, figures: Mapping[str, Any]) -> None:
        """Append one row: its kind (train, validation), its optimizer step, and figures (numbers or lists of them)."""
        row = {"kind": kind, "step": step, **{key: _plain(value) for key, value in figures.items()}}
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()
        self._trackers.log(kind, step, figures)

    def sync(self) -> None:
        """Make the rows survive a power cut: a checkpoint that does would go on without those before it."""
        os.fsync(self._file.fileno())

    def __enter__(self) -> Journal:
        """Return the journal, open."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close the files."""
        self._file.close()
        self._trackers.close()


def read_journal(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of a metrics.jsonl; a last line that a killed process left by halves is passed over.

    Raises:
        InputError: The file is too large to be one.
    """
    if not path.exists():
        return
    for line in read_bounded(path, _MOST_BYTES).decode(errors="replace").splitlines():
        try:
            row = json_object(line, where=str(path), allow_nan=True)
        except InputError:
            row = {}
        if type(row.get("step")) is int and isinstance(row.get("kind"), str):
            yield row
        else:
            logger.warning("%s: a line is not a row of figures, or was left by halves; it is dropped", path)


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None  # JSON has no NaN
    return value
