"""Reading files: find, read and hash them, on this machine and behind URLs.

A path is local, or a URL such as `gs://bucket/folder` (see `remote`). A missing or truncated file is an error of the
file. A network failure is not: it is retried, and finally raises an `UnreachableError`; nor is an error of the
operating system (see `unreadable`). Handlers of broken episodes catch an `InputError`, which this is not.
"""

from __future__ import annotations

import errno
import hashlib
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Protocol, runtime_checkable

from vjepa2_ac.errors import InputError, UnreachableError, UserError
from vjepa2_ac.places import is_url
from vjepa2_ac.storage.remote import ranged_reads
from vjepa2_ac.storage.remote.ranged_reads import FileInfo

_HASH_CHUNK_BYTES = 1 << 20
_ABSENT = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG})


class ShortReadError(OSError):
    """A file ends before the requested bytes."""


@runtime_checkable
class ByteReader(Protocol):
    """A file open for reading, local or ranged_reads."""

    def read(self, size: int = -1, /) -> bytes:
        """Return the next bytes; all remaining ones with -1."""
        ...

    def seek(self, offset: int, /) -> int:
        """Go to an offset from the start."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


def join(folder: str | Path, name: str) -> str:
    """Return the path of a file in a folder."""
    return f"{str(folder).rstrip('/')}/{name}" if is_url(folder) else str(Path(folder) / name)


def absolute(path: str | Path) -> str:
    """Return the absolute path with links resolved, independent of the working directory; a URL unchanged."""
    return str(path) if is_url(path) else str(Path(path).resolve())


def exists(path: str | Path) -> bool:
    """Return whether there is a file or folder."""
    if not is_url(path):
        return Path(path).exists()
    try:
        ranged_reads.file_version(str(path))
    except FileNotFoundError:
        return False
    return True


def file_size(path: str | Path) -> int:
    """Return the size of a file in bytes.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    return ranged_reads.file_size(str(path)) if is_url(path) else Path(path).stat().st_size


def file_version(path: str | Path) -> str:
    """Return a version of a file's content that changes with the content, as far as is known without reading it.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    return ranged_reads.file_version(str(path)) if is_url(path) else str(Path(path).stat().st_mtime_ns)


def list_files(folder: str | Path) -> list[FileInfo]:
    """Return the files of a folder, sorted by name; none where there is no such folder.

    Raises:
        OSError: The folder cannot be listed.
    """
    if is_url(folder):
        return [file for file in ranged_reads.list_folder(str(folder)) if file.is_file]
    files = [path for path in Path(folder).iterdir() if path.is_file()] if Path(folder).is_dir() else []
    found = {path.name: path.stat() for path in files}
    return [FileInfo(name, one.st_size, str(one.st_mtime_ns)) for name, one in sorted(found.items())]


def list_names(folder: str | Path) -> list[str]:
    """Return the names of the files and folders in a folder, sorted; none where there is no such folder."""
    if is_url(folder):
        return [entry.name for entry in ranged_reads.list_folder(str(folder))]
    return sorted(entry.name for entry in Path(folder).iterdir()) if Path(folder).is_dir() else []


def open_to_read(path: str | Path) -> ByteReader:
    """Open a file for reading and seeking; the caller closes it.

    Of a URL only the blocks that are read are fetched, so it can be given to a reader of videos or tables.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    return ranged_reads.open_to_read(str(path)) if is_url(path) else Path(path).open("rb")


def unreadable(where: str, error: OSError, *, needed: str = "", fix: str = "") -> UserError:
    """Return the error of a file that is missing, truncated, or refused by the operating system.

    The last (no permission, too many open files, a disk that went away) is temporary and says nothing about the file's
    content: it is an UnreachableError, which is never stored.

    Args:
        where: The file, and its episode.
        error: The system's error.
        needed: What should be there.
        fix: How to fix it where the file is wrong.
    """
    found = f"cannot be read: {error.strerror or error}"
    if isinstance(error, ShortReadError) or error.errno in _ABSENT:
        return InputError(where=where, found=found, needed=needed, fix=fix)
    return UnreachableError(where=where, found=found, needed=needed, fix="Check its permissions, and the disk")


def read_bytes(path: str | Path) -> bytes:
    """Return the content of a file.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    if is_url(path):
        return ranged_reads.read_range(str(path), 0, ranged_reads.file_size(str(path)))
    return Path(path).read_bytes()


def read_bounded(path: str | Path, most_bytes: int) -> bytes:
    """Return the content of an untrusted small file: at most `most_bytes` are ever read.

    Raises:
        InputError: It is larger, or may never end, such as a pipe.
        OSError: There is no such file, or it cannot be read.
    """
    if is_url(path):
        size = ranged_reads.file_size(str(path))
        data = ranged_reads.read_range(str(path), 0, min(size, most_bytes + 1))
    else:
        if not (stat.S_ISREG(mode := Path(path).stat().st_mode) or stat.S_ISDIR(mode)):
            raise InputError(where=str(path), found="a pipe or a device", needed="a file")
        with Path(path).open("rb") as file:
            data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise InputError(where=str(path), found=f"more than {most_bytes:,} bytes", needed="a file that small")
    return data


def read_range(path: str | Path, start: int, length: int) -> bytes:
    """Return `length` bytes from `start`; fewer if the file ends before.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    if is_url(path):
        return ranged_reads.read_range(str(path), start, length)
    with Path(path).open("rb") as file:
        file.seek(start)
        return file.read(length)


def read_ranges(path: str | Path, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    """Return several (start, length) pieces of a file, each complete; those of a URL are fetched concurrently.

    Raises:
        OSError: There is no such file, it cannot be read, or it ends within a piece.
    """
    pieces = ranged_reads.read_ranges(str(path), ranges) if is_url(path) else list(_local_ranges(path, ranges))
    for (start, length), piece in zip(ranges, pieces, strict=True):
        if len(piece) < length:
            raise ShortReadError(f"{path}: {len(piece)} of {length} bytes at {start}")
    return pieces


def _local_ranges(path: str | Path, ranges: Sequence[tuple[int, int]]) -> Iterator[bytes]:
    with Path(path).open("rb") as file:
        for start, length in ranges:
            file.seek(start)
            yield file.read(length)


def sha256_of_file(path: str | Path, *, progress: Callable[[int], None] = lambda _: None) -> str:
    """Return the SHA-256 of a file as hexadecimal digits, read in chunks.

    Args:
        path: The file.
        progress: Called after every chunk with the bytes read so far.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    digest, done = hashlib.sha256(), 0
    with closing(open_to_read(path)) as file:
        while chunk := file.read(_HASH_CHUNK_BYTES):
            digest.update(chunk)
            done += len(chunk)
            progress(done)
    return digest.hexdigest()
