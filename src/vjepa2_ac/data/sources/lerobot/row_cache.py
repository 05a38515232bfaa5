"""Cache of episode rows, so that a row group of hundreds of episodes is not decoded for each of them."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped

from vjepa2_ac.data.cache.disk_cache import DiskCache
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.npz_reader import read_arrays

Columns = Mapping[str, Shaped[np.ndarray, "rows _"]]


@dataclass(frozen=True)
class RowCache:
    """Rows of episodes on this machine's disk.

    Args:
        cache: Stores them.
        version: Changes with the data set or the wanted columns.
    """

    cache: DiskCache
    version: str

    def read(self, path: str, episode: int) -> Columns | None:
        """Return the cached rows, or None."""
        data = self.cache.read(self._key(path, episode))
        if data is None:
            return None
        try:
            return read_arrays(data)
        except InputError:
            return None

    def write(self, path: str, episode: int, columns: Columns) -> None:
        """Cache the rows of one episode."""
        file = io.BytesIO()
        np.savez(file, **columns)  # type: ignore[arg-type] # names are columns, none is called allow_pickle
        self.cache.write(self._key(path, episode), file.getvalue())

    def _key(self, path: str, episode: int) -> str:
        return f"rows {self.version} {path} {episode}"
