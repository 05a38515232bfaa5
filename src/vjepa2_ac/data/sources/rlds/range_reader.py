"""Reading parts of a file behind a URL with as few requests as possible."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from vjepa2_ac import storage
from vjepa2_ac.data.sources.rlds.dataset_info import Shard

_CHUNK_BYTES = 1 << 20  # long pieces are fetched in parallel chunks of this size


class RemoteFile:
    """Reads a file by ranged requests of at least a window each, and buffers the results.

    Args:
        shard: The file.
        window: Minimum bytes of a request: the next read usually follows the current one.
        buffered: How many of the latest pieces stay; None: all.
    """

    def __init__(self, shard: Shard, *, window: int, buffered: int | None = None) -> None:
        self._shard, self._window = shard, window
        self._pieces: deque[tuple[int, bytes]] = deque(maxlen=buffered)

    def __call__(self, offset: int, length: int) -> bytes:
        """Return bytes of the file; fewer if it ends.

        Raises:
            OSError: It cannot be read.
        """
        length = max(0, min(length, self._shard.size - offset))
        for start, piece in self._pieces:
            if start <= offset and offset + length <= start + len(piece):
                return piece[offset - start : offset - start + length]
        wanted = min(max(length, self._window), self._shard.size - offset)
        if wanted <= 0:
            return b""
        piece = storage.read_range(self._shard.path, offset, wanted)
        self._pieces.append((offset, piece))
        return piece[:length]

    def fetch(self, places: Sequence[tuple[int, int]]) -> None:
        """Fetch missing (offset, length) ranges concurrently."""
        missing = [place for place in places if not self._has(*place)]
        pieces = read_in_parallel(self._shard.path, missing)
        self._pieces.extend((start, piece) for (start, _), piece in zip(missing, pieces, strict=True))

    def pieces_of(self, places: Sequence[tuple[int, int]]) -> list[tuple[int, bytes]]:
        """Return (offset, bytes) of ranges, fetching missing ones."""
        self.fetch(places)
        return [(offset, self(offset, length)) for offset, length in places]

    def hold(self, pieces: Sequence[tuple[int, bytes]]) -> None:
        """Add (offset, bytes) that were fetched before."""
        self._pieces.extend(pieces)

    def _has(self, offset: int, length: int) -> bool:
        return any(start <= offset and offset + length <= start + len(piece) for start, piece in self._pieces)


def read_in_parallel(url: str, places: Sequence[tuple[int, int]]) -> list[bytes]:
    """Return (offset, length) ranges of a file, each complete, long ones in chunks, all fetched concurrently.

    Raises:
        OSError: The file cannot be read, or ends within one.
    """
    chunks = [
        (start, min(_CHUNK_BYTES, offset + length - start))
        for offset, length in places
        for start in range(offset, offset + length, _CHUNK_BYTES)
    ]
    fetched = iter(storage.read_ranges(url, chunks)) if chunks else iter(())
    return [b"".join(next(fetched) for _ in range(offset, offset + length, _CHUNK_BYTES)) for offset, length in places]
