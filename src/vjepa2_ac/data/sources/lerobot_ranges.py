"""How is a large file far away read, here and there, without fetching a piece twice? In blocks, kept on this disk."""

from __future__ import annotations

import io
import os
import threading
from collections import OrderedDict

from vjepa2_ac import storage
from vjepa2_ac.data.disk_cache import DiskCache

_BLOCK_BYTES = 1 << 18
_MOST_AHEAD = 16  # blocks fetched at once where a file is read from front to back
_BLOCKS_IN_MEMORY = 32


class RangedFile(io.RawIOBase):
    """A file behind a URL to read and seek in; each block is fetched once on this machine.

    An error of a fetch stays in `failure`: libraries that read through this object wrap it in one of theirs.

    Args:
        path: The URL.
        version: Differs when the content does; blocks of another version are not used.
        size: The file's size, where it is known.
        kept: Where blocks stay on this machine.
    """

    def __init__(self, path: str, *, version: str, size: int | None, kept: DiskCache) -> None:
        super().__init__()
        self._path, self._kept = path, kept
        self._size = storage.file_size(path) if size is None else size
        self._key = f"{path} {version} {self._size}"
        self._position = 0
        self._ahead, self._expected = 1, 0
        self._blocks: OrderedDict[int, bytes] = OrderedDict()
        self._lock = threading.Lock()
        self.failure: Exception | None = None

    def readable(self) -> bool:
        """Return that it can be read."""
        return True

    def seekable(self) -> bool:
        """Return that any place can be read."""
        return True

    def size(self) -> int:
        """Return how many bytes the file has."""
        return self._size

    def tell(self) -> int:
        """Return where the next read starts."""
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Go to an offset from the start, from here or from the end."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        self._position = max(0, start + offset)
        return self._position

    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next bytes, all that are left with -1; fewer only at the end.

        Raises:
            OSError: They cannot be fetched.
        """
        end = self._size if size is None or size < 0 else min(self._size, self._position + size)
        if end <= self._position:
            return b""
        first, last = self._position // _BLOCK_BYTES, (end - 1) // _BLOCK_BYTES
        try:
            with self._lock:
                data = b"".join(self._fetched(first, last))
        except Exception as error:
            self.failure = error
            raise
        offset = self._position - first * _BLOCK_BYTES
        self._position, length = end, end - self._position
        return data[offset : offset + length]

    def readall(self) -> bytes:
        """Return all that is left."""
        return self.read()

    def _fetched(self, first: int, last: int) -> list[bytes]:
        """Return blocks, from memory, from the disk, and what is left in one read over the network."""
        found = {number: self._known(number) for number in range(first, last + 1)}
        if lacking := [number for number, block in found.items() if block is None]:
            self._ahead = min(2 * self._ahead, _MOST_AHEAD) if lacking[0] == self._expected else 1
            blocks = (self._size + _BLOCK_BYTES - 1) // _BLOCK_BYTES
            end = min(max(lacking[-1] + 1, lacking[0] + self._ahead), blocks)
            found |= self._fetch(lacking[0], end)
            self._expected = end
        result = [block for number in range(first, last + 1) if (block := found[number]) is not None]
        while len(self._blocks) > _BLOCKS_IN_MEMORY:
            self._blocks.popitem(last=False)
        return result

    def _known(self, number: int) -> bytes | None:
        if number in self._blocks:
            self._blocks.move_to_end(number)
            return self._blocks[number]
        block = self._kept.read(f"{self._key} {number}")
        if block is None or len(block) != min(_BLOCK_BYTES, self._size - number * _BLOCK_BYTES):
            return None
        self._blocks[number] = block
        return block

    def _fetch(self, first: int, end: int) -> dict[int, bytes]:
        start = first * _BLOCK_BYTES
        (data,) = storage.read_ranges(self._path, [(start, min(end * _BLOCK_BYTES, self._size) - start)])
        blocks = {
            number: data[number * _BLOCK_BYTES - start : (number + 1) * _BLOCK_BYTES - start]
            for number in range(first, end)
        }
        for number, block in blocks.items():
            self._kept.write(f"{self._key} {number}", block)
        self._blocks |= blocks
        return blocks
