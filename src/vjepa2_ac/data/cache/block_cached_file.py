"""Random access to a large remote file in blocks that are cached on the local disk, so that none is fetched twice."""

from __future__ import annotations

from itertools import groupby

from vjepa2_ac import storage
from vjepa2_ac.data.cache.disk_cache import DiskCache
from vjepa2_ac.storage.remote.buffered_file import BLOCK_BYTES, RangedFile


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
        try:
            return b"".join(self._blocks_of(start // BLOCK_BYTES, (start + length - 1) // BLOCK_BYTES))
        except Exception as error:
            self.failure = error
            raise

    def _blocks_of(self, first: int, last: int) -> list[bytes]:
        """Return blocks from the disk; missing ones are fetched, adjacent ones together."""
        found = {number: self._cached(number) for number in range(first, last + 1)}
        lacking = [number for number, block in found.items() if block is None]
        runs = [
            [number for _, number in run] for _, run in groupby(enumerate(lacking), key=lambda pair: pair[1] - pair[0])
        ]
        ranges = [(run[0] * BLOCK_BYTES, sum(map(self._length_of, run))) for run in runs]
        for run, data in zip(runs, storage.read_ranges(self._path, ranges), strict=True):
            for place, number in enumerate(run):
                block = data[place * BLOCK_BYTES :][: self._length_of(number)]
                self._cache.write(f"{self._key} {number}", block)
                found[number] = block
        return [block for block in found.values() if block is not None]

    def _cached(self, number: int) -> bytes | None:
        block = self._cache.read(f"{self._key} {number}")
        return block if block is not None and len(block) == self._length_of(number) else None

    def _length_of(self, number: int) -> int:
        return min(BLOCK_BYTES, self._bytes - number * BLOCK_BYTES)
