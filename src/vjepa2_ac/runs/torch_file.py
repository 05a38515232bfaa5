"""Torch files: written on a disk that may be full, and read without trusting their content."""

from __future__ import annotations

import pickle
import re
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import torch

from vjepa2_ac.errors import InputError

_DAMAGE = (
    OSError, EOFError, RuntimeError, ValueError, KeyError, TypeError, AttributeError, IndexError, AssertionError,
    OverflowError, MemoryError, NotImplementedError, zipfile.BadZipFile,
)  # fmt: skip


def write_torch(value: object, file: BinaryIO) -> None:
    """Write tensors and plain values.

    Raises:
        OSError: The disk is full, or another system error, which torch itself would hide.
    """
    try:
        torch.save(value, file)
    except RuntimeError as error:
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise


def read_torch(path: Path) -> Any:
    """Return the tensors and plain values of a file, on the CPU. Nothing in it is executed.

    Raises:
        InputError: The file cannot be read, or contains more than tensors and plain values.
    """
    needed = "a file that this program wrote"
    try:
        _require_as_written(path)
        return torch.load(path, weights_only=True, map_location="cpu")
    except pickle.UnpicklingError as error:
        name = re.search(r"GLOBAL (\S+)", str(error))
        found = f"more than tensors and plain values{f' ({name[1]})' if name else ''}: such a file can run foreign code"
        raise InputError(where=str(path), found=found, needed=needed) from None
    except _DAMAGE as error:
        first_line = str(error).strip().partition("\n")[0]
        raise InputError(where=str(path), found=f"cannot be read ({first_line})", needed=needed) from None


def _require_as_written(path: Path) -> None:
    """Refuse other formats that torch reads, too: a small file of these may take any memory.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is no zip archive, or its parts are compressed.
    """
    with zipfile.ZipFile(path) as archive:
        if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
            raise ValueError("its parts are compressed")
