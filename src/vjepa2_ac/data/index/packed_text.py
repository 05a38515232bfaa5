"""Packed text: table columns of one short text per episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np


def pack_texts(name: str, lines: Sequence[str]) -> dict[str, np.ndarray]:
    """Return columns with these texts under a name."""
    encoded = [line.encode() for line in lines]
    ends = np.cumsum([len(line) for line in encoded], dtype=np.int64)
    return {f"{name}_ends": ends, f"{name}_bytes": np.frombuffer(b"".join(encoded), np.uint8)}


def are_texts(ends: np.ndarray, data: np.ndarray | None) -> bool:
    """Return whether `pack_texts` may have made these columns: the ends are in order, and the last is that of data."""
    if data is None or data.dtype != np.uint8 or ends.dtype != np.int64:
        return False
    edges = np.concatenate([[0], ends, [len(data)]])
    return bool((np.diff(edges) >= 0).all() and edges[-2] == edges[-1])


def text_of(name: str, columns: Mapping[str, np.ndarray], index: int) -> str:
    """Return one of the texts that `pack_texts` packed."""
    ends = columns[f"{name}_ends"]
    start = int(ends[index - 1]) if index else 0
    return columns[f"{name}_bytes"][start : int(ends[index])].tobytes().decode(errors="replace")
