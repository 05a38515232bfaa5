"""The lock of a run's folder: two training processes would overwrite each other's checkpoints.

The lock is a kernel lock (flock) on `RUN/.lock`: it is released when its process ends, however it ended. The file
remains, and says who held it last. It is never opened through a link: the target of the link would be truncated.
"""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import platform
from pathlib import Path
from typing import TextIO

from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.own_files import refused_link
from vjepa2_ac.storage import user_can_write
from vjepa2_ac.storage.structured import json_object, utc_now

logger = logging.getLogger(__name__)

LOCK = ".lock"
_MOST_CHARACTERS = 10_000

_TAKEN = frozenset({errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES})


class RunLock:
    """A lock for writing into a run's folder, held from `take` to the end of the `with` block.

    Args:
        folder: The run's folder; `take` creates it if needed.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / LOCK
        self._file: TextIO | None = None

    def take(self) -> None:
        """Take the lock; does nothing if it is held already.

        On a file system without such locks the run continues without one, with a warning.

        Raises:
            InputError: Another process, which is named, holds it; or the folder cannot be written.
        """
        if self._file is not None:
            return
        with user_can_write(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._opened()
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _TAKEN:
                holder = _holder(self._file)
                self.release()
                found = f"a run that is being trained right now, by {holder}"
                needed = "a folder that no other process writes to"
                fix = "Wait until it ends, stop it, or set another run_dir"
                raise InputError(where=str(self.path.parent), found=found, needed=needed, fix=fix) from None
            logger.warning(
                "%s: this file system has no locks (%s): see that no other process trains in this folder",
                self.path, error.strerror,
            )  # fmt: skip
        with user_can_write(self.path):
            _sign(self._file)

    def _opened(self) -> TextIO:
        if self.path.is_symlink():
            raise refused_link(self.path)
        handle = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
        return os.fdopen(handle, "a+", encoding="utf-8")

    def release(self) -> None:
        """Release the lock."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> RunLock:
        """Return the lock, not yet taken."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the lock."""
        self.release()


def _sign(file: TextIO) -> None:
    file.truncate(0)
    file.write(json.dumps({"process": os.getpid(), "host": platform.node(), "since": utc_now()}))
    file.flush()


def _holder(file: TextIO) -> str:
    """Return the holder of the lock, as text."""
    try:
        file.seek(0)
        who = json_object(file.read(_MOST_CHARACTERS), where=LOCK)
        return f"process {who['process']} on {who['host']}, since {who['since']}"
    except (OSError, ValueError, KeyError, InputError):  # it is just writing its name
        return "another process"
