"""Collect the rows of a benchmark and write each to disk at once; after a failed row the others continue."""

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
_LONGEST = 200  # characters of an error in a row


class Rows:
    """All rows of a benchmark. The file is replaced atomically, so an interruption keeps the previous rows.

    Args:
        file: Where rows are written as JSON; None: nowhere.
        about: What holds for all of them.
    """

    def __init__(self, file: Path | None, **about: Any) -> None:
        self.about, self._file = about, file
        self._rows: list[Row] = []

    def add(self, *rows: Row) -> None:
        """Keep rows for good."""
        self._rows += rows
        self.so_far()

    def so_far(self, *rows: Row) -> None:
        """Write the rows that were added, and after them some that are not finished; those are not kept."""
        if self._file is not None:
            whole = {**self.about, "rows": [*self._rows, *({**row, "finished": False} for row in rows)]}
            write_atomically(self._file, json.dumps(_finite(whole), indent=1) + "\n")

    def attempt(self, work: Callable[[], Result], **about: Any) -> Result | None:
        """Return what work returns, or None where it fails; that is a row of its own then, and is printed."""
        try:
            return work()
        except Exception as error:
            row = {**about, "problem": problem_of(error)}
        print(", ".join(str(value) for value in row.values()), flush=True)
        self.add(row)
        return None

    def finish(self) -> None:
        """End the program with an error if any row has failed.

        Raises:
            SystemExit: One has.
        """
        failed = sum(any(str(value).startswith(FAILED) for value in row.values()) for row in self._rows)
        if failed:
            raise SystemExit(f"{failed} of {len(self._rows)} rows failed")


def problem_of(error: Exception) -> str:
    """Return what a row says of an error, whose traceback is printed: out of memory, or failed and why."""
    if isinstance(error, torch.OutOfMemoryError) or OUT_OF_MEMORY in str(error):  # CUDA's own is a RuntimeError
        return OUT_OF_MEMORY
    traceback.print_exception(error, file=sys.stderr)
    lines = str(error).strip().splitlines() or [""]
    return f"{FAILED}: {type(error).__name__}: {lines[0]}"[:_LONGEST]


def cell(value: float | None, width: int, form: str) -> str:
    """Return a number as wide as its column, a dash where there is none."""
    return f"{'-' if value is None else format(value, form):>{width}}"


def _finite(value: Any) -> Any:
    """Return what JSON can hold: null where a number is none."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
