"""Data sets for loader workers: one fails in a way that PyTorch does not report."""

import os
from dataclasses import dataclass
from typing import Any

from torch.utils.data import Dataset


@dataclass(frozen=True)
class Rows(Dataset[Any]):
    """Returns its positions; at position 2 it fails."""

    failure: str = ""

    def __getitems__(self, positions: list[int]) -> Any:
        if 2 in positions and self.failure == "dies":
            os._exit(9)
        return (lambda: None) if 2 in positions and self.failure == "cannot be sent" else positions
