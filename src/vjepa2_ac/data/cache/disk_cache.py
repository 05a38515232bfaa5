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
_ROOM_LEFT = 0.1  # share of the limit that is freed when it is reached, so that entries are scanned seldom
_ABANDONED_S = 3600.0


class DiskCache:
    """Entries of bytes under keys in a local folder; the least recently used are evicted at the limit.

    Any number of threads and processes may use one folder, with one limit. The total size of the entries never exceeds
    the limit. The sum of their sizes is stored in a locked ledger: entries are scanned only when it reaches the limit.
    A damaged entry counts as absent, and so do all entries if the folder cannot be used: that causes a warning, never
    an error.

    Args:
        folder: Created with the first entry.
        limit_bytes: Total size of all entries; a larger entry is not stored, so with 0 none is.
    """

    def __init__(self, folder: str | Path, limit_bytes: int) -> None:
        self._folder, self._limit = Path(folder), limit_bytes
        self._warned = False

    def read(self, key: str) -> bytes | None:
        """Return the entry of a key, or None; it counts as used now."""
        path = self._path(key)
        try:
            content = path.read_bytes()
        except OSError:  # usually: absent
            return None
        with suppress(OSError):  # evicted meanwhile, or in a read-only folder
            os.utime(path)
        data = _checked(content)
        if data is None:
            logger.warning("%s: damaged, fetched again", path)
            with suppress(OSError):
                path.unlink()
        return data

    def write(self, key: str, data: bytes) -> None:
        """Store bytes under a key, replacing an old entry; a warning is logged if that is not possible."""
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
        """Lock the ledger, a file with the sum of all sizes, for one process and thread."""
        handle = os.open(self._folder / _LEDGER, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield handle
        finally:
            os.close(handle)  # and with it the lock

    def _make_room(self, ledger: int, path: Path, size: int) -> int:
        """Delete the entry to be replaced, and others if the limit would be exceeded; return the remaining size."""
        replaced = _size_of(path)
        if replaced:
            path.unlink(missing_ok=True)
        try:
            total = int(os.pread(ledger, 20, 0)) - replaced
        except ValueError:  # new or damaged
            return self._evict(self._limit - size)
        return total if total + size <= self._limit else self._evict(self._limit - size)

    def _evict(self, allowed: int) -> int:
        """Delete the least recently used entries until there is some room; return the remaining size."""
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
    """Return the cache of fetched data: one for all sources and runs, with one limit."""
    return DiskCache(cache_folder(config) / "fetched", int(config.limit_gb * 1e9))


def _checked(content: bytes) -> bytes | None:
    """Return the data of an entry, or None if it is damaged."""
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
    """Yield last use, size and path of every entry; partial files of killed writers are removed."""
    for inner in [entry.path for entry in os.scandir(folder) if entry.is_dir()]:
        for entry in os.scandir(inner):
            with suppress(FileNotFoundError):  # damaged, deleted by a reader
                stat = entry.stat()
                if not entry.name.endswith(_PARTIAL):
                    yield stat.st_mtime_ns, stat.st_size, entry.path
                elif time.time() - stat.st_mtime > _ABANDONED_S:
                    Path(entry.path).unlink()
