"""Array files written by this program, read back without trusting their content."""

from __future__ import annotations

import io
from math import prod

import numpy as np

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.npz_reader import NpzFile


def read_arrays(data: bytes, where: str = "its arrays") -> dict[str, np.ndarray]:
    """Return the arrays that `numpy.savez` wrote; nothing is unpickled, and nothing expands beyond the file's size.

    Raises:
        InputError: It is another kind of file, damaged, compressed, or inconsistent.
    """
    file = NpzFile(io.BytesIO(data), where)
    headers = {name: file.header(name) for name in file.names}
    total = sum(prod(header.shape) * header.dtype.itemsize for header in headers.values())
    if total > len(data):
        found = f"arrays of {total:,} bytes in a file of {len(data):,}"
        raise InputError(where=where, found=found, needed="arrays that are not compressed")
    return {name: file.array(name).copy() for name in file.names}
