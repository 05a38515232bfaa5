"""Seekable remote file: reads ranges on demand and buffers a few of them."""

from __future__ import annotations

import io
from collections import OrderedDict
from collections.abc import Callable

BLOCK_BYTES = 128 << 10
_READ_AHEAD_BLOCKS = 32  # at most, for sequential reads
_CACHED_BLOCKS = 128


class RangedFile(io.RawIOBase):
    """A seekable file that is fetched in blocks; the last 16 MB read are cached.

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

    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next `size` bytes, fewer if the file ends; all remaining ones with -1."""
        if self.closed:
            raise ValueError("the file is closed")
        start = min(self._position, self._size)
        end = self._size if size is None or size < 0 else min(start + size, self._size)
        data = self._range(start, end)
        self._position += len(data)
        return data

    def readall(self) -> bytes:
        """Return all remaining bytes."""
        return self.read()

    def readinto(self, buffer: bytearray | memoryview, /) -> int:  # type: ignore[override] # any writable buffer
        """Fill a buffer with the next bytes; return how many there were."""
        view = memoryview(buffer).cast("B")
        data = self.read(len(view))
        view[: len(data)] = data
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
