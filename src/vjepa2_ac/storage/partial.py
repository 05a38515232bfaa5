"""Partial files: the temporary name of a file until it is complete, and their removal after a killed writer.

The name is `.NAME.KERNEL-RANDOM.partial`, in the target folder. The writer holds a lock on it (flock), which the kernel
releases when the writer ends, however it ended. The next writer into that folder removes partial files without a lock.

Why a lock: process ids are reused, and mean nothing in another container. But a lock may not be visible to another
machine that shares the disk. KERNEL identifies the machine: a hash of the kernel's boot id, the same for all containers
on it. A partial file of another kernel, or one that cannot be locked, is removed when it is unchanged for a day.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import functools
import hashlib
import os
import platform
import re
import secrets
import shutil
import stat
import time
from collections.abc import Iterator
from pathlib import Path

_OLD_S = 86_400.0
_BOOT = Path("/proc/sys/kernel/random/boot_id")
_NAME = re.compile(r"\..+\.(?:([0-9a-f]{8})-)?[0-9a-f]+\.partial")  # without KERNEL: of earlier versions
_NAME_BYTES = 200  # of the 255 that a name may have
_HELD = frozenset({errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES})


@contextlib.contextmanager
def new_partial(parent: Path, name: str, *, is_folder: bool = False) -> Iterator[Path]:
    """Yield a new empty file or folder in `parent`, to be renamed to `name`, and locked meanwhile; it is not removed.

    Raises:
        OSError: It cannot be created.
    """
    parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned_once(parent.absolute())
    while True:
        path = _new_name(parent, name)
        if is_folder:
            path.mkdir()
        handle = os.open(path, os.O_RDONLY if is_folder else os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if _locked(path, handle):
            break
    try:
        yield path
    finally:
        os.close(handle)


def is_partial(path: Path) -> bool:
    """Return whether this is the name of a partial file: one being written, or left by a killed writer."""
    return _NAME.fullmatch(path.name) is not None


def remove_abandoned(folder: Path) -> None:
    """Remove the partial files of dead writers in a folder; those that cannot be removed stay."""
    with contextlib.suppress(OSError):
        for path in [path for path in folder.iterdir() if is_partial(path)]:
            with contextlib.suppress(OSError):
                _remove_if_abandoned(path)


@functools.cache
def _remove_abandoned_once(folder: Path) -> None:
    """Scan a folder only the first time that this process writes there: it may hold thousands of files."""
    remove_abandoned(folder)


def _remove_if_abandoned(path: Path) -> None:
    is_folder = stat.S_ISDIR(path.lstat().st_mode)
    found = _NAME.fullmatch(path.name)
    way = os.O_RDONLY if is_folder else os.O_RDWR  # some file systems lock only files open for writing
    handle = os.open(path, way | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        if found is not None and found[1] == _kernel():
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno in _HELD or not _is_old(path):
                    return
        elif not _is_old(path):
            return
        if is_folder:
            shutil.rmtree(path)
        else:
            path.unlink()
    finally:
        os.close(handle)


def _is_old(path: Path) -> bool:
    newest = max(one.lstat().st_mtime for one in (path, *path.rglob("*")))
    return time.time() - newest > _OLD_S


def _locked(path: Path, handle: int) -> bool:
    """Lock a new partial file; return whether it still exists (another process may have removed it) or close it."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        ours = path.exists()
    except OSError as error:  # usually a file system without locks
        ours = error.errno not in _HELD
    if not ours:
        os.close(handle)
    return ours


def _new_name(folder: Path, name: str) -> Path:
    short = name.encode(errors="surrogateescape")[:_NAME_BYTES].decode(errors="ignore")
    return folder / f".{short}.{_kernel()}-{secrets.token_hex(4)}.partial"


@functools.cache
def _kernel() -> str:
    try:
        drawn = _BOOT.read_text(encoding="ascii")
    except OSError:  # not Linux
        drawn = platform.node()
    return hashlib.blake2b(drawn.encode(), digest_size=4).hexdigest()
