"""CRC marks: which records of a data set have had their CRC checked on this machine."""

from __future__ import annotations

import logging
import os
from pathlib import Path

logger = logging.getLogger(__name__)

_CHECKED = b"\xc3"  # not all bits equal, so that a damaged file seldom contains false marks


class CrcMarks:
    """A mark for each record, in a file that all loader processes share: one byte each.

    A mark that cannot be read counts as missing; one that cannot be written causes a warning and another check.

    Args:
        path: The file; created with the first mark.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._warned = path, False

    def __contains__(self, number: int) -> bool:
        """Return whether a record has been checked."""
        try:
            with self._path.open("rb") as file:
                file.seek(number)
                return file.read(1) == _CHECKED
        except OSError:
            return False

    def add(self, number: int) -> None:
        """Mark a record as checked."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(self._path, os.O_WRONLY | os.O_CREAT, 0o666)
            try:
                os.pwrite(handle, _CHECKED, number)
            finally:
                os.close(handle)
        except OSError as error:
            if not self._warned:
                logger.warning("%s: cannot be written (%s); records are checked each time", self._path, error)
            self._warned = True
