"""Seekable remote files, fetched block by block on demand, and the local disk cache of remote bytes.

`DiskCache` stores blocks of these files, and other remote bytes. No block is fetched twice.
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

from vjepa2_ac.errors import describe_refusal
from vjepa2_ac.storage import remote

logger = logging.getLogger(__name__)

BLOCK_BYTES = 128 << 10
_READ_AHEAD_BLOCKS = 32  # largest number of blocks of a sequential read
_CACHED_BLOCKS = 128  # blocks of a file in memory

_EVICTION_TARGET = (
    0.8  # an eviction reduces the folder to this fraction of the limit, so that scans of the folder are rare
)
_CRC_BYTES = 4  # appended to the data of an entry
_TOTAL_BYTES = 8  # length of the total size stored in the file `lock`
_PART = struct.Struct(">QQI")  # start, size and CRC of a part of an entry


class RangedFile(io.RawIOBase):
    """A seekable file that is fetched in blocks; the last 16 MB that were read are cached in memory.

    A read after a seek fetches one block of 128 KB. Each sequential read fetches twice as much as the previous one, up
    to 4 MB. So the header of a video needs few bytes, and a whole file needs few requests.

    Args:
        fetch: Returns the bytes for (start, length). The range is always a number of whole blocks.
        size: Size of the file in bytes.
    """

    def __init__(self, fetch: Callable[[int, int], bytes], size: int) -> None:
        super().__init__()
        self._fetch, self._size = fetch, size
        self._position = 0
        self._blocks: OrderedDict[int, bytes] = OrderedDict()
        self._fetched_to, self._read_ahead = -1, 1

    def readable(self) -> bool:
        """Return True: the file can be read."""
        return True

    def seekable(self) -> bool:
        """Return True: the file can seek."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Move to an offset from the start, the current position or the end; return the new position from the start."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size}[whence]
        if base + offset < 0:
            raise ValueError(f"negative position {base + offset}")
        self._position = base + offset
        return self._position

    def readinto(self, buffer: bytearray | memoryview, /) -> int:  # type: ignore[override] # any writable buffer
        """Fill a buffer with the next bytes; return the number of bytes read."""
        view = memoryview(buffer).cast("B")
        data = self._read_range(self._position, min(self._position + len(view), self._size))
        view[: len(data)] = data
        self._position += len(data)
        return len(data)

    def _read_range(self, start: int, end: int) -> bytes:
        if start >= end:
            return b""
        first, last = start // BLOCK_BYTES, (end - 1) // BLOCK_BYTES
        blocks: dict[int, bytes] = {}
        for number in range(first, last + 1):
            if number not in blocks:
                blocks |= self._load(number, last)
        data = b"".join(blocks[number] for number in range(first, last + 1))
        return data[start - first * BLOCK_BYTES : end - first * BLOCK_BYTES]

    def _load(self, number: int, last: int) -> dict[int, bytes]:
        """Return block `number`; if it must be fetched, also the blocks up to `last` or the next cached block."""
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
    """A key-value store of bytes in a local folder; at the size limit the least recently used entries are evicted.

    Any number of threads and processes may use one folder. The file `lock` contains the total size of the entries. A
    writer adds the size of its entry to the total before it stores the entry. If the total would exceed the limit, the
    writer first scans the folder and evicts entries down to 80 % of the limit, while other writers wait. So the folder
    exceeds the limit by at most one entry for each thread that was storing an entry during the last scan.

    If the folder cannot be used, a warning is logged and all entries count as absent.

    Args:
        folder: The folder, which is created with the first entry.
        limit_bytes: Total size of all entries, in bytes. An entry larger than 80 % of the limit is not stored. With 0
            no entry is stored or evicted. None: no limit.
    """

    def __init__(self, folder: str | Path, limit_bytes: int | None) -> None:
        self._folder, self._limit = Path(folder), limit_bytes
        self._refused = set[Path]()

    def read(self, key: str) -> bytes | None:
        """Return the entry of a key, or None if the entry is absent or damaged; mark the entry as just used."""
        path = self._path(key)
        try:
            content = path.read_bytes()
        except OSError as error:
            self._note_refusal(path, error)
            return None
        with suppress(OSError):  # the entry was evicted meanwhile, or the folder is read-only
            os.utime(path)
        data, crc = content[:-_CRC_BYTES], content[-_CRC_BYTES:]
        return data if crc == _crc(data) else None

    def write(self, key: str, data: bytes) -> None:
        """Store bytes under a key, replacing an old entry; log a warning if that is not possible."""
        path, content = self._path(key), data + _crc(data)
        if path in self._refused or (self._limit is not None and len(content) > self._limit * _EVICTION_TARGET):
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

    def read_or_create(self, key: str, make: Callable[[], bytes]) -> bytes:
        """Return the entry of a key; if it is absent, create it with `make` and store it."""
        data = self.read(key)
        if data is None:
            data = make()
            self.write(key, data)
        return data

    def write_parts(self, key: str, parts: Sequence[bytes]) -> None:
        """Store a list of parts under a key, as `write` does; `read_parts` reads selected parts."""
        starts = accumulate(map(len, parts), initial=len(parts) * _PART.size)
        table = [_PART.pack(start, len(part), zlib.crc32(part)) for start, part in zip(starts, parts, strict=False)]
        self.write(key, b"".join([*table, *parts]))

    def read_parts(self, key: str, count: int, numbers: Sequence[int]) -> list[bytes] | None:
        """Read and return the parts `numbers` of an entry of `count` parts; None if the entry is absent or damaged."""
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
        """Log one warning per cache, and do not write an entry again that could not be read or written."""
        if isinstance(error, FileNotFoundError):
            return
        if not self._refused:
            text = "%s: the disk cache cannot be used (%s). The data are fetched again"
            logger.warning(text, error.filename or self._folder, describe_refusal(error)[0])
        self._refused.add(path)

    def _path(self, key: str) -> Path:
        name = hashlib.sha256(key.encode()).hexdigest()[:40]
        return self._folder / name[:2] / name[2:]

    def _reserve(self, size: int) -> None:
        """Add the size of an entry to the total size of the folder; evict other entries first if it does not fit."""
        if not self._limit:
            return
        with os.fdopen(os.open(self._folder / "lock", os.O_RDWR | os.O_CREAT, 0o666), "r+b", buffering=0) as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            try:
                total = int.from_bytes(lock.read(_TOTAL_BYTES), "big")
                if total == 0 or total + size > self._limit:  # 0: the file is new, or a power failure emptied it
                    total = self._evict(size, self._limit)
                os.pwrite(lock.fileno(), (total + size).to_bytes(_TOTAL_BYTES, "big"), 0)
            finally:
                fcntl.flock(lock, fcntl.LOCK_UN)  # closing is not enough if a process was forked meanwhile

    def _evict(self, size: int, limit: int) -> int:
        """Evict the least recently used entries if `size` more bytes do not fit; return the remaining total size."""
        entries = sorted(self._entries())
        total = sum(entry_size for _, entry_size, _ in entries)
        if total + size <= limit:
            return total
        for _, entry_size, path in entries:
            if total + size <= limit * _EVICTION_TARGET:
                break
            Path(path).unlink(missing_ok=True)
            total -= entry_size
        return total

    def _entries(self) -> Iterator[tuple[int, int, str]]:
        """Yield last use, size and path of every entry, and of partial files left behind by killed writers."""
        for subfolder in [entry.path for entry in os.scandir(self._folder) if entry.is_dir()]:
            for entry in os.scandir(subfolder):
                with suppress(FileNotFoundError):  # renamed meanwhile
                    stat = entry.stat()
                    yield stat.st_mtime_ns, stat.st_size, entry.path


def _crc(data: bytes) -> bytes:
    return zlib.crc32(data).to_bytes(_CRC_BYTES, "big")


class BlockCachedFile(RangedFile):
    """A seekable file behind a URL; each block is fetched once per machine.

    The error of a failed fetch is stored in `failure`, because a library that reads this file may raise an error of
    another type instead.

    Args:
        path: The URL.
        version: Version of the content; blocks of other versions are not used.
        size: Size of the file in bytes.
        cache: The local cache of blocks.
    """

    def __init__(self, path: str, *, version: str, size: int, cache: DiskCache) -> None:
        super().__init__(self._fetch_blocks, size)
        self._path, self._cache = path, cache
        self._bytes, self._key = size, f"{path} {version} {size}"
        self.failure: Exception | None = None

    def _fetch_blocks(self, start: int, length: int) -> bytes:
        """Return the bytes of whole blocks from the disk cache or the URL."""
        blocks = [
            (block_start, min(BLOCK_BYTES, self._bytes - block_start))
            for block_start in range(start, start + length, BLOCK_BYTES)
        ]
        try:
            return b"".join(cached_ranges(self._path, blocks, key=self._key, cache=self._cache))
        except Exception as error:
            self.failure = error
            raise


def cached_ranges(url: str, ranges: Sequence[tuple[int, int]], *, key: str, cache: DiskCache) -> list[bytes]:
    """Return several (start, length) ranges of a file behind a URL, each complete, using the disk cache.

    Missing ranges are fetched concurrently; adjacent ranges are fetched in one request.

    Args:
        url: The file.
        ranges: Non-empty (start, length) ranges.
        key: Identifies the content of the file.
        cache: The cache, in which each range is a separate entry.

    Raises:
        OSError: There is no such file, or it ends within a range.
        UnreachableError: The file cannot be reached.
    """
    contents = {byte_range: cache.read(f"{key} {byte_range}") or b"" for byte_range in ranges}
    missing = sorted(byte_range for byte_range, data in contents.items() if len(data) != byte_range[1])
    for byte_range, data in zip(missing, remote.read_adjacent_ranges(url, missing), strict=True):
        contents[byte_range] = data
        cache.write(f"{key} {byte_range}", data)
    return [contents[byte_range] for byte_range in ranges]


def open_remote(url: str) -> RangedFile:
    """Open a file behind a URL for reading and seeking; reads are retried and are not cached on the disk.

    Raises:
        OSError: There is no such file.
        UnreachableError: The file cannot be reached.
    """
    return RangedFile(lambda start, length: remote.read_ranges(url, [(start, length)])[0], remote.file_size(url))
