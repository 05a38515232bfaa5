"""Packed text: table columns of one short text per episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np


class NotPackedTextError(ValueError):
    """Columns are not a result of `pack_texts`."""


def pack_texts(name: str, lines: Sequence[str]) -> dict[str, np.ndarray]:
    """Return columns with these texts under a name."""
    encoded = [line.encode() for line in lines]
    ends = np.cumsum([len(line) for line in encoded], dtype=np.int64)
    return {f"{name}_ends": ends, f"{name}_bytes": np.frombuffer(b"".join(encoded), np.uint8)}


def require_texts(ends: np.ndarray, data: np.ndarray | None) -> None:
    """Refuse columns that `pack_texts` cannot have made.

    Raises:
        NotPackedTextError: The ends are not within the bytes, or not in order.
    """
    fits = data is not None and data.dtype == np.uint8 and ends.dtype == np.int64
    edges = np.concatenate([[0], ends, [0 if data is None else len(data)]])
    if not fits or (np.diff(edges) < 0).any() or edges[-2] != edges[-1]:
        raise NotPackedTextError("no lines")


def text_of(name: str, columns: Mapping[str, np.ndarray], index: int) -> str:
    """Return one of the texts that `pack_texts` packed."""
    ends = columns[f"{name}_ends"]
    start = int(ends[index - 1]) if index else 0
    return columns[f"{name}_bytes"][start : int(ends[index])].tobytes().decode(errors="replace")
