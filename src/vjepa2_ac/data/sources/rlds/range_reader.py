"""Reading parts of a file behind a URL with as few requests as possible."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from vjepa2_ac import storage
from vjepa2_ac.data.sources.rlds.dataset_info import Shard

_CHUNK_BYTES = 1 << 20  # long pieces are fetched in parallel chunks of this size


class RemoteFile:
    """Reads a file by ranged requests, each as long as a window at least, and keeps what came.

    Args:
        shard: The file.
        window: Bytes of a request, at least: what is read next lies most often behind what is read now.
        kept: How many of the latest pieces stay; None: all.
    """

    def __init__(self, shard: Shard, *, window: int, kept: int | None = None) -> None:
        self._shard, self._window = shard, window
        self._pieces: deque[tuple[int, bytes]] = deque(maxlen=kept)

    def __call__(self, offset: int, length: int) -> bytes:
        """Return bytes of the file; fewer where it ends.

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
        """Bring (offset, length) places here at the same time, those that are not."""
        missing = [place for place in places if not self._has(*place)]
        pieces = read_in_parallel(self._shard.path, missing)
        self._pieces.extend((start, piece) for (start, _), piece in zip(missing, pieces, strict=True))

    def pieces_of(self, places: Sequence[tuple[int, int]]) -> list[tuple[int, bytes]]:
        """Return (offset, bytes) of places, fetching what is not here."""
        self.fetch(places)
        return [(offset, self(offset, length)) for offset, length in places]

    def hold(self, pieces: Sequence[tuple[int, bytes]]) -> None:
        """Take (offset, bytes) that were fetched before."""
        self._pieces.extend(pieces)

    def _has(self, offset: int, length: int) -> bool:
        return any(start <= offset and offset + length <= start + len(piece) for start, piece in self._pieces)


def read_in_parallel(url: str, places: Sequence[tuple[int, int]]) -> list[bytes]:
    """Return (offset, length) places of a file, each whole, long ones in chunks, all at the same time.

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
