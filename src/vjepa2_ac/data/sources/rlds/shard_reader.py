"""Reading parts of a shard: of a local one that may change meanwhile, or behind a URL with few requests."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from vjepa2_ac import storage
from vjepa2_ac.data.sources.rlds.wire_format import Read
from vjepa2_ac.errors import InputError, UserError

_CHUNK_BYTES = 1 << 20  # long pieces are fetched in parallel chunks of this size


@dataclass(frozen=True)
class Shard:
    """One TFRecord file of a data set, and its expected number of episodes."""

    path: str
    episodes: int
    size: int = 0  # bytes
    version: str = ""  # as from `storage.list_files`: changes with the content

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.replace("\\", "/").rsplit("/", 1)[-1]

    def unreadable(self, error: OSError) -> UserError:
        """Return the error of a file that the system or a server refuses to read."""
        return storage.unreadable(self.path, error, needed="a TFRecord file")


@contextmanager
def open_shard(shard: Shard) -> Iterator[Read]:
    """Open a local shard for random access, also from several threads.

    Nothing is mapped into memory: a file that is truncated during use gives short reads, not a crash.

    Raises:
        InputError: The file cannot be read, or has changed since the data set was opened.
    """
    try:
        handle = os.open(shard.path, os.O_RDONLY)
    except OSError as error:
        raise shard.unreadable(error) from None
    try:
        found = os.fstat(handle)
        if (found.st_size, str(found.st_mtime_ns)) != (shard.size, shard.version):
            changed = f"{found.st_size:,} bytes: it has changed since the data set was opened"
            needed = f"the file of {shard.size:,} bytes that was there"
            raise InputError(where=shard.path, found=changed, needed=needed, fix="Start again")
        yield lambda offset, length: os.pread(handle, length, offset)
    except OSError as error:
        raise shard.unreadable(error) from None
    finally:
        os.close(handle)


class RemoteFile:
    """Reads a shard behind a URL by requests of at least a window each, and buffers the results.

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
        known = self._buffered(offset, length)
        if known is not None:
            return known
        wanted = min(max(length, self._window), self._shard.size - offset)
        if wanted <= 0:
            return b""
        piece = storage.read_range(self._shard.path, offset, wanted)
        self._pieces.append((offset, piece))
        return piece[:length]

    def pieces_of(self, places: Sequence[tuple[int, int]]) -> list[tuple[int, bytes]]:
        """Return (offset, bytes) of (offset, length) ranges; missing ones are fetched concurrently."""
        missing = [place for place in places if self._buffered(*place) is None]
        pieces = read_in_parallel(self._shard.path, missing)
        self.hold([(start, piece) for (start, _), piece in zip(missing, pieces, strict=True)])
        return [(offset, self(offset, length)) for offset, length in places]

    def hold(self, pieces: Sequence[tuple[int, bytes]]) -> None:
        """Add (offset, bytes) that were fetched before."""
        self._pieces.extend(pieces)

    def _buffered(self, offset: int, length: int) -> bytes | None:
        for start, piece in self._pieces:
            if start <= offset and offset + length <= start + len(piece):
                return piece[offset - start : offset - start + length]
        return None


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
