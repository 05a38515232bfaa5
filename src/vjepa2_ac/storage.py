"""How are files listed, read, written and hashed, on this machine and behind URLs?

A path is local, or an fsspec URL such as `gs://bucket/folder`; fsspec is imported for URLs only.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Protocol, cast, runtime_checkable

_HASH_CHUNK_BYTES = 1 << 20


@runtime_checkable
class ByteReader(Protocol):
    """What a file that is open to read can do, wherever it is."""

    def read(self, size: int = -1, /) -> bytes:
        """Return the next bytes, all that are left with -1."""
        ...

    def seek(self, offset: int, /) -> int:
        """Go to an offset from the start."""
        ...

    def close(self) -> None:
        """Give the file back."""
        ...


def is_url(path: str | Path) -> bool:
    """Return whether a path names a file behind fsspec (`gs://…`) rather than one on this machine."""
    return "://" in str(path)


def join(folder: str | Path, name: str) -> str:
    """Return the path of a file in a folder."""
    return f"{str(folder).rstrip('/')}/{name}" if is_url(folder) else str(Path(folder) / name)


def exists(path: str | Path) -> bool:
    """Return whether there is a file or folder."""
    return bool(_filesystem(path).exists(str(path))) if is_url(path) else Path(path).exists()


def file_size(path: str | Path) -> int:
    """Return the size of a file in bytes.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    return int(_filesystem(path).size(str(path))) if is_url(path) else Path(path).stat().st_size


def list_names(folder: str | Path) -> list[str]:
    """Return the names of the files and folders in a folder, sorted; none where there is no such folder."""
    if not is_url(folder):
        return sorted(entry.name for entry in Path(folder).iterdir()) if Path(folder).is_dir() else []
    try:
        found = _filesystem(folder).ls(str(folder), detail=False)
    except FileNotFoundError:
        return []
    return sorted(str(path).rstrip("/").rsplit("/", 1)[-1] for path in found)


def open_to_read(path: str | Path) -> ByteReader:
    """Open a file to read and seek in; the caller closes it.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    return cast("ByteReader", _filesystem(path).open(str(path), "rb") if is_url(path) else Path(path).open("rb"))


def read_bytes(path: str | Path) -> bytes:
    """Return a whole file.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    with closing(open_to_read(path)) as file:
        return file.read()


def read_range(path: str | Path, start: int, length: int) -> bytes:
    """Return `length` bytes from `start`; fewer where the file ends before.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    with closing(open_to_read(path)) as file:
        file.seek(start)
        return file.read(length)


@contextmanager
def atomic_writer(path: str | Path) -> Iterator[BinaryIO]:
    """Open a local file that appears under its name, whole, when the block ends, and not at all when it fails.

    Missing folders are made. The bytes are on the disk (fsync) before the file gets its name.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except BaseException:
        with suppress(FileNotFoundError):
            temporary.unlink()
        raise
    sync_folder(target.parent)


def write_atomically(path: str | Path, data: bytes | str) -> None:
    """Write a local file so that it is never seen in part; text is written as UTF-8."""
    with atomic_writer(path) as file:
        file.write(data.encode() if isinstance(data, str) else data)


def sync_folder(folder: str | Path) -> None:
    """Make the names in a local folder survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sha256_of_file(path: str | Path) -> str:
    """Return the SHA-256 of a file as hexadecimal digits, reading it piece by piece.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    digest = hashlib.sha256()
    with closing(open_to_read(path)) as file:
        while chunk := file.read(_HASH_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def _filesystem(url: str | Path) -> Any:
    import fsspec

    return fsspec.core.url_to_fs(str(url))[0]
