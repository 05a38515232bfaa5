"""How do as many short texts as there are episodes fit into columns of a table?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np


def pack_lines(name: str, lines: Sequence[str]) -> dict[str, np.ndarray]:
    """Return columns that hold these texts under a name."""
    encoded = [line.encode() for line in lines]
    ends = np.cumsum([len(line) for line in encoded], dtype=np.int64)
    return {f"{name}_ends": ends, f"{name}_bytes": np.frombuffer(b"".join(encoded), np.uint8)}


def line_of(name: str, columns: Mapping[str, np.ndarray], index: int) -> str:
    """Return one of the texts that `pack_lines` packed."""
    ends = columns[f"{name}_ends"]
    start = int(ends[index - 1]) if index else 0
    return columns[f"{name}_bytes"][start : int(ends[index])].tobytes().decode()
