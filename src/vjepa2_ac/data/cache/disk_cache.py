"""The disk cache of remote data: bounded in size, shared by all loader processes."""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import struct
import threading
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from vjepa2_ac.config import DiskCacheConfig
from vjepa2_ac.data.index.index_cache import cache_folder

logger = logging.getLogger(__name__)

_HEADER = struct.Struct("<4sIQ")  # magic, CRC-32 of the data, its length
_MAGIC = b"VJC1"
_LEDGER = "ledger"
_PARTIAL = ".partial"
_ROOM_LEFT = 0.1  # share of the limit that is freed when it is reached, so that entries are looked through seldom
_ABANDONED_S = 3600.0


class DiskCache:
    """Entries of bytes under keys in a local folder; those used longest ago go when the limit is reached.

    Any number of threads and processes may use one folder, with one limit. Together the entries never take more than
    the limit. The sum of their sizes stands in a locked ledger: only when it reaches the limit are the entries looked
    through. A damaged entry counts as absent, and so does everything where the folder cannot be used: that costs a
    warning, never the run.

    Args:
        folder: Made when the first entry is written.
        limit_bytes: Size of all entries together; an entry that is larger is not kept, so with 0 none is.
    """

    def __init__(self, folder: str | Path, limit_bytes: int) -> None:
        if limit_bytes < 0:
            raise ValueError(f"limit_bytes is {limit_bytes}")
        self._folder, self._limit = Path(folder), limit_bytes
        self._warned = False

    def read(self, key: str) -> bytes | None:
        """Return what was written under a key, or None; it counts as used now."""
        path = self._path(key)
        try:
            content = path.read_bytes()
        except OSError:  # most often: not there
            return None
        with suppress(OSError):  # evicted by now, or in a folder that may only be read
            os.utime(path)
        data = _checked(content)
        if data is None:
            logger.warning("%s: damaged, fetched again", path)
            with suppress(OSError):
                path.unlink()
        return data

    def write(self, key: str, data: bytes) -> None:
        """Keep bytes under a key, in place of what was there; a warning is logged where that is not possible."""
        path = self._path(key)
        size = _HEADER.size + len(data)
        if size > self._limit:
            return
        partial = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}{_PARTIAL}")
        try:
            if not path.parent.is_dir():
                path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as file:
                file.write(_HEADER.pack(_MAGIC, zlib.crc32(data), len(data)))
                file.write(data)
            with self._ledger() as ledger:
                total = self._make_room(ledger, path, size)
                partial.replace(path)
                os.pwrite(ledger, b"%020d" % (total + size), 0)
        except OSError as error:
            with suppress(OSError):
                partial.unlink()
            if not self._warned:
                logger.warning("%s: %s; the run goes on and fetches again", self._folder, error.strerror)
            self._warned = True

    def _path(self, key: str) -> Path:
        name = hashlib.sha256(key.encode()).hexdigest()[:40]
        return self._folder / name[:2] / name[2:]

    @contextmanager
    def _ledger(self) -> Iterator[int]:
        """Hold the ledger, a file with the sum of all sizes, for one process and thread alone."""
        handle = os.open(self._folder / _LEDGER, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield handle
        finally:
            os.close(handle)  # and with it the lock

    def _make_room(self, ledger: int, path: Path, size: int) -> int:
        """Delete the entry that is to be replaced, and others where the limit would be passed; return what is left."""
        replaced = _size_of(path)
        if replaced:
            path.unlink(missing_ok=True)
        try:
            total = int(os.pread(ledger, 20, 0)) - replaced
        except ValueError:  # new or damaged
            return self._evict(self._limit - size)
        return total if total + size <= self._limit else self._evict(self._limit - size)

    def _evict(self, allowed: int) -> int:
        """Delete the entries used longest ago until the rest leaves some room; return the size of the rest."""
        entries = sorted(_entries(self._folder))
        total = sum(size for _, size, _ in entries)
        if total <= allowed:
            return total
        wanted = allowed - int(self._limit * _ROOM_LEFT)
        for _, size, path in entries:
            if total <= wanted:
                break
            with suppress(FileNotFoundError):
                Path(path).unlink()
            total -= size
        return total


def fetched_data(config: DiskCacheConfig) -> DiskCache:
    """Return the cache of what was fetched, one for all sources and runs: so the limit is one, too."""
    return DiskCache(cache_folder(config) / "fetched", int(config.limit_gb * 1e9))


def _checked(content: bytes) -> bytes | None:
    """Return the data of an entry, or None where it is not what was written."""
    if len(content) < _HEADER.size:
        return None
    magic, crc, length = _HEADER.unpack_from(content)
    data = content[_HEADER.size :]
    return data if magic == _MAGIC and len(data) == length and zlib.crc32(data) == crc else None


def _size_of(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _entries(folder: Path) -> Iterator[tuple[int, int, str]]:
    """Yield last use, size and path of every entry; what an interrupted writer left behind goes."""
    for inner in [entry.path for entry in os.scandir(folder) if entry.is_dir()]:
        for entry in os.scandir(inner):
            with suppress(FileNotFoundError):  # damaged, deleted by a reader
                stat = entry.stat()
                if not entry.name.endswith(_PARTIAL):
                    yield stat.st_mtime_ns, stat.st_size, entry.path
                elif time.time() - stat.st_mtime > _ABANDONED_S:
                    Path(entry.path).unlink()
