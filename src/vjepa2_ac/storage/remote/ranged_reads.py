"""Reading remote data: `gs://`, `hf://`, `s3://` and every other protocol of fsspec.

All network failures are handled here (see `retries`): the result is the data, FileNotFoundError as from a disk, or
UnreachableError. Every function may be called from many threads, and in every process.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.storage.remote import retries
from vjepa2_ac.storage.remote.buffered_file import RangedFile
from vjepa2_ac.storage.remote.filesystems import GOOGLE, ask, is_asynchronous, login_hint, size_of

_T = TypeVar("_T")

_THREADS = 64  # concurrent reads of `read_ranges` in a process
_PIECE_BYTES = 16 << 20  # longer reads are split: each piece has the full time-out
_VERSION_KEYS = ("generation", "etag", "ETag", "blob_id", "mtime", "last_modified", "LastModified", "created")


class FileInfo(NamedTuple):
    """A file or folder in a listing, on this machine or at a server."""

    name: str
    size: int
    version: str  # changes with the content, as far as is known without reading it
    is_file: bool = True


def file_size(url: str) -> int:
    """Return the size of a file in bytes.

    Raises:
        FileNotFoundError: There is no such file.
        UnreachableError: It cannot be reached.
    """
    return _persist(url, lambda timeout_s: size_of(url, timeout_s))


def file_version(url: str) -> str:
    """Return the server's version of a file's content, which changes with the content; empty where there is none.

    Raises:
        FileNotFoundError: There is no such file or folder.
        UnreachableError: It cannot be reached.
    """
    return _version_of(_call(url, "info"))


def list_folder(url: str) -> list[FileInfo]:
    """Return the entries of a folder, sorted by name: one listing, one call per page; none if there is no such folder.

    Raises:
        UnreachableError: It cannot be reached.
    """
    try:
        listed = _call(url, "ls", detail=True, refresh=True)
    except FileNotFoundError:
        return []
    return sorted(
        FileInfo(
            name=str(found["name"]).rstrip("/").rsplit("/", 1)[-1],
            size=int(found.get("size") or 0),
            version=_version_of(found),
            is_file=found["type"] == "file",
        )
        for found in listed
    )


def read_range(url: str, start: int, length: int) -> bytes:
    """Return `length` bytes from `start`; fewer only if the file ends.

    Raises:
        FileNotFoundError: There is no such file.
        UnreachableError: It cannot be reached.
    """
    if length > _PIECE_BYTES:
        cuts = range(start, start + length, _PIECE_BYTES)
        return b"".join(read_ranges(url, [(cut, min(_PIECE_BYTES, start + length - cut)) for cut in cuts]))
    return _persist(url, lambda timeout_s: _read_once(url, start, length, timeout_s)) if length > 0 else b""


def read_ranges(url: str, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    """Return several (start, length) pieces of a file, read concurrently; shorter only if the file ends.

    Raises:
        FileNotFoundError: There is no such file.
        UnreachableError: It cannot be reached.
    """
    if len(ranges) < 2 or any(length > _PIECE_BYTES for _, length in ranges):
        return [read_range(url, start, length) for start, length in ranges]
    return list(_threads(os.getpid()).map(lambda piece: read_range(url, *piece), ranges))


def open_to_read(url: str) -> RangedFile:
    """Open a file for reading and seeking; its reads are retried, too.

    Raises:
        FileNotFoundError: There is no such file.
        UnreachableError: It cannot be reached.
    """

    def fetch(start: int, length: int) -> bytes:
        data = read_range(url, start, length)
        if len(data) < length:
            found = f"{len(data)} of {length} bytes at {start}; the file has become shorter"
            raise UnreachableError(where=url, found=found, fix="Start again")
        return data

    return RangedFile(fetch, file_size(url))


def bytes_fetched() -> int:
    """Return how many bytes of files this process has read so far, including failed attempts."""
    return _fetched.total


class _Counter:
    def __init__(self) -> None:
        self.total, self._lock = 0, threading.Lock()

    def add(self, number: int) -> None:
        with self._lock:
            self.total += number


_fetched = _Counter()


@lru_cache(maxsize=1)
def _threads(process: int) -> ThreadPoolExecutor:  # noqa: ARG001 - threads do not survive a fork
    return ThreadPoolExecutor(_THREADS, thread_name_prefix="remote")


def _call(url: str, method: str, **arguments: Any) -> Any:
    return _persist(url, lambda timeout_s: ask(url, method, timeout_s, **arguments))


def _version_of(found: Mapping[str, Any]) -> str:
    return next((str(found[key]) for key in _VERSION_KEYS if found.get(key) is not None), "")


def _read_once(url: str, start: int, length: int, timeout_s: float) -> bytes:
    """Read a range; accept a short answer only at the end of the file."""
    bare: dict[str, Any] = {} if is_asynchronous(url) else {"cache_type": "none"}  # else megabytes are prefetched
    try:
        data: bytes = ask(url, "cat_file", timeout_s, start=start, end=start + length, **bare)
    except Exception as error:
        if retries.status_of(error) != 416:
            raise
        data = b""  # the server has nothing at `start`
    _fetched.add(len(data))
    if len(data) == length:
        return data
    there = max(0, min(start + length, size_of(url, timeout_s)) - start)
    if len(data) != there:
        raise ConnectionError(f"{len(data)} of {there} bytes at {start}")
    return data


def _persist(url: str, action: Callable[[float], _T]) -> _T:
    try:
        return retries.with_retries(url, action, policy=retries.DEFAULT, access=login_hint(url))
    except FileNotFoundError:
        _require_bucket(url)
        raise


def _require_bucket(url: str) -> None:
    """Distinguish a missing bucket from a missing file; Google's answers are the same.

    Raises:
        UnreachableError: There is no such bucket.
    """
    protocol, _, path = url.partition("://")
    bucket = path.split("/", 1)[0]
    if protocol not in GOOGLE or bucket in _known_buckets:
        return
    root = f"{protocol}://{bucket}"

    def list_one(timeout_s: float) -> Any:
        return ask(root, "list_objects", timeout_s, max_results=1)

    try:
        retries.with_retries(root, list_one, policy=retries.DEFAULT, access="")
    except FileNotFoundError:
        raise UnreachableError(where=url, found=f"there is no bucket {bucket}", fix="Check its name") from None
    except UnreachableError as error:
        if "no permission" not in error.found:
            raise
    _known_buckets.add(bucket)


_known_buckets: set[str] = set()
