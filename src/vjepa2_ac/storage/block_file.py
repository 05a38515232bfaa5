"""A seekable file of blocks that are fetched when they are read, and cached on the local disk: none is fetched twice.

`DiskCache` is the one cache of remote bytes: whole files and parts of them use it too.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import logging
import os
import secrets
import struct
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import accumulate
from pathlib import Path

from vjepa2_ac.errors import refusal_of
from vjepa2_ac.storage import remote

logger = logging.getLogger(__name__)

BLOCK_BYTES = 128 << 10
_READ_AHEAD_BLOCKS = 32  # at most, for sequential reads
_CACHED_BLOCKS = 128

_KEPT_SHARE = 0.8  # of the limit, after an eviction: so that a scan of the folder is rare
_CRC_BYTES = 4  # behind the data of an entry
_TOTAL_BYTES = 8  # length of the number in the file `lock`
_PART = struct.Struct(">QQI")  # start, size and CRC of a part of an entry


class RangedFile(io.RawIOBase):
    """A seekable file that is fetched in blocks; the last 16 MB read are cached in memory.

    A seek costs one block of 128 KB. Sequential reads fetch twice as much each time, up to 4 MB. So a video's header,
    or one group of its frames, costs little more than its bytes, and a whole file few reads.

    Args:
        fetch: Returns exactly `length` bytes from `start`: called with (start, length), which are of whole blocks.
        size: Size of the file.
    """

    def __init__(self, fetch: Callable[[int, int], bytes], size: int) -> None:
        super().__init__()
        self._fetch, self._size = fetch, size
        self._position = 0
        self._blocks: OrderedDict[int, bytes] = OrderedDict()
        self._fetched_to, self._read_ahead = -1, 1

    def readable(self) -> bool:
        """Return that it can be read."""
        return True

    def seekable(self) -> bool:
        """Return that it can seek."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Go to an offset from the start, the current position or the end; return it from the start, as `tell` does."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size}[whence]
        if base + offset < 0:
            raise ValueError(f"negative position {base + offset}")
        self._position = base + offset
        return self._position

    def readinto(self, buffer: bytearray | memoryview, /) -> int:  # type: ignore[override] # any writable buffer
        """Fill a buffer with the next bytes; return how many there were."""
        view = memoryview(buffer).cast("B")
        data = self._range(self._position, min(self._position + len(view), self._size))
        view[: len(data)] = data
        self._position += len(data)
        return len(data)

    def _range(self, start: int, end: int) -> bytes:
        if start >= end:
            return b""
        first, last = start // BLOCK_BYTES, (end - 1) // BLOCK_BYTES
        pieces: dict[int, bytes] = {}
        for number in range(first, last + 1):
            if number not in pieces:
                pieces |= self._load(number, last)
        data = b"".join(pieces[number] for number in range(first, last + 1))
        return data[start - first * BLOCK_BYTES : end - first * BLOCK_BYTES]

    def _load(self, number: int, last: int) -> dict[int, bytes]:
        """Return a block by number; if it must be fetched, also the wanted ones up to the next cached block."""
        if number in self._blocks:
            self._blocks.move_to_end(number)
            return {number: self._blocks[number]}
        self._read_ahead = min(2 * self._read_ahead, _READ_AHEAD_BLOCKS) if number == self._fetched_to else 1
        stop = max(last + 1, number + self._read_ahead)
        stop = next((other for other in range(number + 1, stop) if other in self._blocks), stop)
        start = number * BLOCK_BYTES
        data = self._fetch(start, min(stop * BLOCK_BYTES, self._size) - start)
        blocks = {number + i: data[i * BLOCK_BYTES : (i + 1) * BLOCK_BYTES] for i in range(stop - number)}
        self._fetched_to = stop
        self._blocks |= blocks
        while len(self._blocks) > _CACHED_BLOCKS:
            self._blocks.popitem(last=False)
        return blocks


class DiskCache:
    """Entries of bytes under keys in a local folder; the least recently used are evicted at the limit.

    Any number of threads and processes may use one folder. The file `lock` holds the total size of its entries. A
    writer adds the size of its entry to the total before it stores the entry. If the total would exceed the limit, the
    writer first scans the folder and evicts entries down to 80 % of the limit, while other writers wait. So the folder
    exceeds the limit by at most one entry for each thread that was storing an entry during the last scan.

    If the folder cannot be used, all entries count as absent: that causes a warning, never an error.

    Args:
        folder: Created with the first entry.
        limit_bytes: Total size of all entries, in bytes. An entry of more than 80 % of it is not stored, so with 0 none
            is; with 0 none is evicted either. None: no limit.
    """

    def __init__(self, folder: str | Path, limit_bytes: int | None) -> None:
        self._folder, self._limit = Path(folder), limit_bytes
        self._refused = set[Path]()

    def read(self, key: str) -> bytes | None:
        """Return the entry of a key, or None if there is none or it is damaged; the entry counts as used now."""
        path = self._path(key)
        try:
            content = path.read_bytes()
        except OSError as error:
            self._note_refusal(path, error)
            return None
        with suppress(OSError):  # evicted meanwhile, or in a read-only folder
            os.utime(path)
        data, crc = content[:-_CRC_BYTES], content[-_CRC_BYTES:]
        return data if crc == _crc(data) else None

    def write(self, key: str, data: bytes) -> None:
        """Store bytes under a key, replacing an old entry; a warning is logged if that is not possible."""
        path, content = self._path(key), data + _crc(data)
        if path in self._refused or (self._limit is not None and len(content) > self._limit * _KEPT_SHARE):
            return
        partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._reserve(len(content))
            try:
                partial.write_bytes(content)
                with suppress(FileNotFoundError):  # evicted meanwhile
                    partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
        except OSError as error:
            self._note_refusal(path, error)

    def read_or_make(self, key: str, make: Callable[[], bytes]) -> bytes:
        """Return the entry of a key; make and store it if there is none."""
        data = self.read(key)
        if data is None:
            data = make()
            self.write(key, data)
        return data

    def write_parts(self, key: str, parts: Sequence[bytes]) -> None:
        """Store a list of parts under a key, as `write` does; `read_parts` returns some of them."""
        starts = accumulate(map(len, parts), initial=len(parts) * _PART.size)
        table = [_PART.pack(start, len(part), zlib.crc32(part)) for start, part in zip(starts, parts, strict=False)]
        self.write(key, b"".join([*table, *parts]))

    def read_parts(self, key: str, count: int, numbers: Sequence[int]) -> list[bytes] | None:
        """Return some of the `count` parts of an entry without reading the others; None if absent or damaged."""
        path = self._path(key)
        try:
            with path.open("rb", buffering=0) as file:
                table = [*_PART.iter_unpack(file.read(count * _PART.size))]
                parts = [os.pread(file.fileno(), table[number][1], table[number][0]) for number in numbers]
        except OSError as error:
            self._note_refusal(path, error)
            return None
        except (OverflowError, MemoryError, IndexError, struct.error):
            return None
        with suppress(OSError):
            os.utime(path)
        return parts if [zlib.crc32(part) for part in parts] == [table[number][2] for number in numbers] else None

    def _note_refusal(self, path: Path, error: OSError) -> None:
        """Warn once; an entry that is there, and that the system refuses, is not replaced."""
        if isinstance(error, FileNotFoundError):
            return
        if not self._refused:
            text = "%s: cannot be used (%s); its data are fetched again"
            logger.warning(text, error.filename or self._folder, refusal_of(error)[0])
        self._refused.add(path)

    def _path(self, key: str) -> Path:
        name = hashlib.sha256(key.encode()).hexdigest()[:40]
        return self._folder / name[:2] / name[2:]

    def _reserve(self, size: int) -> None:
        """Add the size of an entry to the total of the folder, after an eviction if it does not fit."""
        if not self._limit:
            return
        with os.fdopen(os.open(self._folder / "lock", os.O_RDWR | os.O_CREAT, 0o666), "r+b", buffering=0) as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            try:
                total = int.from_bytes(lock.read(_TOTAL_BYTES), "big")
                if total == 0 or total + size > self._limit:  # 0: a new file, or a power cut emptied it
                    total = self._evict(size, self._limit)
                os.pwrite(lock.fileno(), (total + size).to_bytes(_TOTAL_BYTES, "big"), 0)
            finally:
                fcntl.flock(lock, fcntl.LOCK_UN)  # closing is not enough: a process forked meanwhile has the file open

    def _evict(self, size: int, limit: int) -> int:
        """Evict the least recently used entries if one of this size does not fit; return the total size of the rest."""
        entries = sorted(self._entries())
        total = sum(entry_size for _, entry_size, _ in entries)
        if total + size <= limit:
            return total
        for _, entry_size, path in entries:
            if total + size <= limit * _KEPT_SHARE:
                break
            Path(path).unlink(missing_ok=True)
            total -= entry_size
        return total

    def _entries(self) -> Iterator[tuple[int, int, str]]:
        """Yield last use, size and path of every entry, and of what killed writers left of one."""
        for inner in [entry.path for entry in os.scandir(self._folder) if entry.is_dir()]:
            for entry in os.scandir(inner):
                with suppress(FileNotFoundError):  # renamed meanwhile
                    stat = entry.stat()
                    yield stat.st_mtime_ns, stat.st_size, entry.path


def _crc(data: bytes) -> bytes:
    return zlib.crc32(data).to_bytes(_CRC_BYTES, "big")


class BlockCachedFile(RangedFile):
    """A seekable file behind a URL; each block is fetched once per machine.

    The error of a fetch stays in `failure`: libraries that read through this object may wrap it in their own.

    Args:
        path: The URL.
        version: Changes with the content; blocks of another version are not used.
        size: The file's size.
        cache: The local cache of blocks.
    """

    def __init__(self, path: str, *, version: str, size: int, cache: DiskCache) -> None:
        super().__init__(self._fetched, size)
        self._path, self._cache = path, cache
        self._bytes, self._key = size, f"{path} {version} {size}"
        self.failure: Exception | None = None

    def _fetched(self, start: int, length: int) -> bytes:
        """Return whole blocks: no others are requested."""
        blocks = [(at, min(BLOCK_BYTES, self._bytes - at)) for at in range(start, start + length, BLOCK_BYTES)]
        try:
            return b"".join(cached_ranges(self._path, blocks, key=self._key, cache=self._cache))
        except Exception as error:
            self.failure = error
            raise


def cached_ranges(url: str, ranges: Sequence[tuple[int, int]], *, key: str, cache: DiskCache) -> list[bytes]:
    """Return several (start, length) pieces of a file behind a URL, each complete, from the disk where they are there.

    Missing ones are fetched concurrently, adjacent ones together.

    Args:
        url: The file.
        ranges: None of them empty.
        key: Of the file's content.
        cache: Keeps each piece by itself.

    Raises:
        OSError: There is no such file, or it ends within a piece.
        UnreachableError: It cannot be reached.
    """
    found = {one: cache.read(f"{key} {one}") or b"" for one in ranges}
    lacking = sorted(one for one, data in found.items() if len(data) != one[1])
    for one, data in zip(lacking, remote.read_neighbours(url, lacking), strict=True):
        found[one] = data
        cache.write(f"{key} {one}", data)
    return [found[one] for one in ranges]


def open_remote(url: str) -> RangedFile:
    """Open a file behind a URL for reading and seeking; its reads are retried, and not cached on the disk.

    Raises:
        OSError: There is no such file.
        UnreachableError: It cannot be reached.
    """
    return RangedFile(lambda start, length: remote.read_ranges(url, [(start, length)])[0], remote.file_size(url))
