"""Collect the rows of a benchmark, and write each row to disk at once. A failed row does not stop the benchmark."""

from __future__ import annotations

import json
import math
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch

from vjepa2_ac.storage import write_atomically

Row = dict[str, Any]
Result = TypeVar("Result")

OUT_OF_MEMORY = "out of memory"  # a result, not a failure
FAILED = "failed"
_MAX_PROBLEM_CHARACTERS = 200  # maximum length of an error in a row


class Rows:
    """All rows of a benchmark. The file is replaced atomically, so an interruption keeps the previous rows.

    Args:
        file: The JSON file to which rows are written; None: no file.
        about: Values that are the same for all rows.
    """

    def __init__(self, file: Path | None, **about: Any) -> None:
        self.about, self._file = about, file
        self._rows: list[Row] = []

    def add(self, *rows: Row) -> None:
        """Add finished rows, and write the file."""
        self._rows += rows
        self.write_unfinished()

    def write_unfinished(self, *rows: Row) -> None:
        """Write the added rows, followed by unfinished rows. The next write omits the unfinished rows."""
        if self._file is not None:
            content = {**self.about, "rows": [*self._rows, *({**row, "finished": False} for row in rows)]}
            write_atomically(self._file, json.dumps(_replace_non_finite(content), indent=1) + "\n")

    def attempt(self, work: Callable[[], Result], **about: Any) -> Result | None:
        """Return the result of `work`. If it fails, add and print a row with the problem, and return None."""
        try:
            return work()
        except Exception as error:
            row = {**about, "problem": describe_failure(error)}
        print(", ".join(str(value) for value in row.values()), flush=True)
        self.add(row)
        return None

    def finish(self) -> None:
        """Exit with an error if any row has failed.

        Raises:
            SystemExit: A row has failed.
        """
        failed = sum(any(str(value).startswith(FAILED) for value in row.values()) for row in self._rows)
        if failed:
            raise SystemExit(f"{failed} of {len(self._rows)} rows failed")


def describe_failure(error: Exception) -> str:
    """Return the text for an error in a row: out of memory, or failed with the reason, whose traceback is printed."""
    if isinstance(error, torch.OutOfMemoryError) or OUT_OF_MEMORY in str(error):  # CUDA raises a RuntimeError
        return OUT_OF_MEMORY
    traceback.print_exception(error, file=sys.stderr)
    lines = str(error).strip().splitlines() or [""]
    return f"{FAILED}: {type(error).__name__}: {lines[0]}"[:_MAX_PROBLEM_CHARACTERS]


def format_cell(value: float | None, width: int, form: str) -> str:
    """Return a number, right-aligned in the width of its column; a dash for None."""
    return f"{'-' if value is None else format(value, form):>{width}}"


def _replace_non_finite(value: Any) -> Any:
    """Replace NaN and infinity, which JSON does not support, by None."""
    if isinstance(value, dict):
        return {key: _replace_non_finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_non_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
