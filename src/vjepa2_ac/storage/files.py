"""Files on this machine and behind URLs: find, read and hash them; write local files atomically.

A path is local, or a URL such as `gs://bucket/folder` (see `remote`). An episode with a missing or truncated file
counts as broken. Network failures are retried, and finally raise an `UnreachableError`. Other errors of the operating
system raise it at once (see `read_error`). The file itself may then be intact.

A file is written under a temporary name, `.NAME.RANDOM.partial` in the target folder, and renamed when it is complete
and on the disk. A later writer removes partial files of killed writers after one day.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import io
import os
import re
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from vjepa2_ac.errors import InputError, MissingFileError, RefusedError, UnreachableError, UserError, describe_refusal
from vjepa2_ac.storage import remote
from vjepa2_ac.storage.block_file import RangedFile, open_remote
from vjepa2_ac.storage.paths import is_url
from vjepa2_ac.storage.remote import FileInfo, ShortReadError

_MISSING_ERRNOS = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG})
_DISK_FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT})
_WRITE_ERRNOS = (
    _DISK_FULL_ERRNOS
    | _MISSING_ERRNOS
    | {errno.EACCES, errno.EPERM, errno.EROFS, errno.EEXIST, errno.EINVAL, errno.ELOOP}
)
_PARTIAL = re.compile(r"\..+\.[0-9a-f]{8}\.partial")
_NAME_BYTES = 200  # leaves space for the suffix of a temporary name; most file systems allow 255 bytes
_ABANDONED_AFTER_S = 86_400.0
_POINTER_BYTES = 1024  # git-lfs pointers are smaller


ByteReader = RangedFile | io.BufferedIOBase
"""A file open for reading and seeking, behind a URL or on this machine."""


# ---- find and read ----


def join(folder: str | Path, name: str) -> str:
    """Return the path of a file in a folder, or the path of the folder itself if the name is empty."""
    if not name:
        return str(folder)
    return f"{str(folder).rstrip('/')}/{name}" if is_url(folder) else str(Path(folder) / name)


def canonical_path(path: str | Path) -> str:
    """Return the canonical form of a path or URL, without a trailing slash.

    A local path or a `file://` URL becomes an absolute path in which symbolic links are resolved.
    """
    local = str(path).removeprefix("file://")
    return local.rstrip("/") if is_url(local) else str(Path(local).resolve())


def exists(path: str | Path) -> bool:
    """Return whether a file or folder exists at a path or URL."""
    if not is_url(path):
        return Path(path).exists()
    try:
        remote.file_version(str(path))
    except FileNotFoundError:
        return False
    return True


def file_size(path: str | Path) -> int:
    """Return the size of a file in bytes.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    return remote.file_size(str(path)) if is_url(path) else Path(path).stat().st_size


def file_version(path: str | Path) -> str:
    """Return a version string that changes when a file's content changes, without reading the content.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    return remote.file_version(str(path)) if is_url(path) else str(Path(path).stat().st_mtime_ns)


def list_folder(folder: str | Path) -> list[FileInfo]:
    """Return the files and folders in a folder, sorted by name; an empty list if there is no such folder.

    Raises:
        OSError: The folder cannot be listed.
    """
    if is_url(folder):
        return remote.list_folder(str(folder))
    paths = sorted(Path(folder).iterdir()) if Path(folder).is_dir() else []
    stats = {path.name: path.stat() if path.is_file() else None for path in paths}
    return [
        FileInfo(name, status.st_size, str(status.st_mtime_ns)) if status else FileInfo(name, 0, "", is_file=False)
        for name, status in stats.items()
    ]


def list_files(folder: str | Path) -> list[FileInfo]:
    """Return the files in a folder, as `list_folder` does."""
    return [file for file in list_folder(folder) if file.is_file]


def list_names(folder: str | Path) -> list[str]:
    """Return the names of the files and folders in a folder, sorted."""
    return [entry.name for entry in list_folder(folder)]


def require_regular_file(path: str | Path, size: int | None = None) -> None:
    """Refuse a git-lfs pointer, a pipe or a device in place of a file. Of large files nothing is read.

    Args:
        path: The file, which may be missing.
        size: The file's size in bytes, if known. Without it only local files are checked; a pointer behind a URL is
            refused when its first bytes are read.

    Raises:
        InputError: The file is a pointer, a pipe or a device.
        UnreachableError: The file is at a URL and cannot be read.
    """
    with suppress(OSError):  # the caller reports a file that cannot be read
        if size is None:
            if is_url(path) or stat.S_ISDIR((status := Path(path).stat()).st_mode):
                return
            if not stat.S_ISREG(status.st_mode):
                raise InputError(where=str(path), found="a pipe or a device", needed="a regular file")
            size = status.st_size
        if size < _POINTER_BYTES:
            remote.refuse_pointer(str(path), read_range(path, 0, size))


def open_for_reading(path: str | Path) -> ByteReader:
    """Open a file for reading and seeking; the caller closes it.

    Behind a URL only the blocks that are read are fetched.

    Raises:
        InputError: The file is a git-lfs pointer, a pipe or a device.
        OSError: There is no such file, or it cannot be read.
    """
    require_regular_file(path)
    return open_remote(str(path)) if is_url(path) else Path(path).open("rb")


def read_error(where: str, error: OSError, *, needed: str = "", fix: str = "") -> UserError:
    """Return the error of a file that is missing, truncated, or refused by the operating system.

    For a missing file the error is a MissingFileError, and for a truncated file an InputError. After a refusal (no
    permission, too many open files, a disconnected disk) the file may be intact. The error is then an UnreachableError,
    for which a file is never removed, replaced or recorded as broken. Missing permission is a RefusedError, with the
    mode and the owner of the file.

    Args:
        where: The file and its episode, for messages.
        error: The system's error.
        needed: The expected kind of file.
        fix: How to fix a missing or truncated file.
    """
    if isinstance(error, FileNotFoundError | NotADirectoryError):  # for a URL the error has no errno
        reason = os.strerror(errno.ENOENT)
        return MissingFileError(where=where, found=f"cannot be read: {reason}", needed=needed, fix=fix)
    problem = f"cannot be read: {error.strerror or error}"
    if isinstance(error, ShortReadError | IsADirectoryError) or error.errno in _MISSING_ERRNOS:
        return InputError(where=where, found=problem, needed=needed, fix=fix)
    refusal, fix = describe_refusal(error)
    kind = RefusedError if isinstance(error, PermissionError) else UnreachableError
    return kind(where=where, found=f"cannot be read: {refusal}", needed=needed, fix=fix)


def is_os_read_error(error: BaseException) -> bool:
    """Return whether an error is from the operating system, rather than from a library that found a damaged file."""
    # EINVAL: a seek to a negative position, caused by an offset in a damaged file.
    return isinstance(error, OSError) and error.errno != errno.EINVAL


@contextmanager
def translate_read_errors(path: str | Path, *, needed: str = "", fix: str = "") -> Iterator[None]:
    """Raise an error for the user if a file cannot be read, or is a git-lfs pointer, a pipe or a device.

    Raises:
        UserError: Instead of any OSError; see `read_error` and `require_regular_file`.
    """
    try:
        require_regular_file(path)
        yield
    except OSError as error:
        raise read_error(str(path), error, needed=needed, fix=fix) from None


def read_bytes(path: str | Path) -> bytes:
    """Return the content of a file.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    if is_url(path):
        return remote.read_range(str(path), 0, remote.file_size(str(path)))
    return Path(path).read_bytes()


def read_small_file(path: str | Path, max_bytes: int) -> bytes:
    """Return the content of a small untrusted file, reading at most `max_bytes` + 1 bytes.

    Raises:
        InputError: The file is larger, or a git-lfs pointer, a pipe or a device.
        OSError: There is no such file, or it cannot be read.
    """
    require_regular_file(path)
    length = min(file_size(path), max_bytes + 1) if is_url(path) else max_bytes + 1
    data = read_range(path, 0, length)
    if len(data) > max_bytes:
        raise InputError(where=str(path), found="the file is too large", needed=f"at most {max_bytes:,} bytes")
    return data


def read_range(path: str | Path, start: int, length: int) -> bytes:
    """Return `length` bytes of a file from `start`; fewer if the file ends earlier.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    if is_url(path):
        return remote.read_range(str(path), start, length)
    with Path(path).open("rb") as file:
        file.seek(start)
        return file.read(length)


def read_ranges(path: str | Path, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    """Return several (start, length) ranges of a file, each complete; behind a URL they are fetched concurrently.

    Raises:
        OSError: There is no such file, it cannot be read, or it ends within a range.
        UnreachableError: The URL cannot be reached.
    """
    if is_url(path):
        return remote.read_ranges(str(path), ranges)
    contents = []
    with Path(path).open("rb") as file:
        for start, length in ranges:
            file.seek(start)
            contents.append(file.read(length))
            if len(contents[-1]) < length:
                raise ShortReadError(f"{path}: {len(contents[-1])} of {length} bytes at {start}")
    return contents


def sha256_of_file(path: Path) -> str:
    """Return the SHA-256 of a local file as hexadecimal digits.

    Raises:
        OSError: There is no such file, or it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# ---- write local files ----


@contextmanager
def atomic_writer(path: str | Path) -> Iterator[BinaryIO]:
    """Open a local file for writing; it appears under its name only if the `with` block ends without an error.

    Missing folders are created. The bytes are on the disk (fsync) before the file is renamed to its final name.
    """
    target = Path(path)
    temporary = _new_partial(target.parent, target.name)
    try:
        with temporary.open("xb") as file:  # opened by name: some libraries choose the format from `file.name`
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:  # the error of a full disk has no file name
            error.filename = str(target)
        raise
    sync(target.parent)


def write_atomically(path: str | Path, data: bytes | str) -> None:
    """Write a local file atomically; text is written as UTF-8."""
    with atomic_writer(path) as file:
        file.write(data.encode() if isinstance(data, str) else data)


@contextmanager
def folder_writer(folder: str | Path, manifest: str) -> Iterator[Path]:
    """Yield an empty temporary folder, and move its files to `folder` if the `with` block ends without an error.

    A new folder appears complete. An existing folder is not replaced (it may be the working directory, or mounted) and
    keeps its other files. The old manifest is removed first and the new manifest is moved last, so a folder with a
    manifest is always complete.

    Args:
        folder: The target folder; missing folders are created.
        manifest: Name of the file that marks the folder as complete.

    Raises:
        InputError: The folder cannot be created or written, or the disk is full.
    """
    target = Path(folder).resolve()
    with translate_write_errors(folder):
        is_folder = target.is_dir()
        if target.exists() and not is_folder:
            raise NotADirectoryError(errno.ENOTDIR, "it is a file, not a folder")
        temporary = _new_partial(target if is_folder else target.parent, target.name)
        temporary.mkdir()
    try:
        with translate_write_errors(
            folder, errors=_DISK_FULL_ERRNOS
        ):  # the caller handles all other errors of the block
            yield temporary
        with translate_write_errors(folder):
            if is_folder:
                _move_into(target, temporary, manifest)
            else:
                temporary.replace(target)
            sync(target if is_folder else target.parent)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _move_into(target: Path, source: Path, manifest: str) -> None:
    (target / manifest).unlink(missing_ok=True)
    files = [path.relative_to(source) for path in source.rglob("*") if path.is_file()]
    for file in sorted(files, key=lambda file: file == Path(manifest)):
        (target / file).parent.mkdir(parents=True, exist_ok=True)
        (source / file).replace(target / file)
    shutil.rmtree(source)


def sync(path: str | Path) -> None:
    """Flush the bytes of a local file, or the names in a local folder, to the disk (fsync)."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def translate_write_errors(path: str | Path, errors: frozenset[int] = _WRITE_ERRNOS) -> Iterator[None]:
    """Raise an error for the user if a local path cannot be written, or the disk is full.

    Raises:
        InputError: Instead of an OSError whose number is in `errors`. Other errors are not changed.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in errors:
            raise
        is_full = error.errno in _DISK_FULL_ERRNOS
        fix = "Free some space, or choose a path on another disk" if is_full else "Choose a path that can be written"
        raise InputError(where=str(path), found=f"cannot be written: {error.strerror}", fix=fix) from None


def is_empty(folder: Path) -> bool:
    """Return whether a folder is empty, apart from partial files of killed writers."""
    return all(_PARTIAL.fullmatch(path.name) for path in folder.iterdir())


def require_new_folder(folder: Path) -> None:
    """Check that a path does not exist or is an empty folder.

    Raises:
        InputError: The path is a file or a folder that is not empty, or cannot be listed.
    """
    with translate_write_errors(folder):
        is_free = not folder.exists() or (folder.is_dir() and is_empty(folder))
    if not is_free:
        problem = "the folder exists and is not empty" if folder.is_dir() else "a file with this name exists"
        raise InputError(where=str(folder), found=problem, fix="Delete it, or choose another path")


def check_local_writable(path: Path) -> None:
    """Test with a temporary file whether a folder, or its nearest existing parent, can be written.

    Raises:
        OSError: The folder cannot be written.
    """
    with tempfile.TemporaryFile(dir=_nearest_existing(path)):
        pass


def free_bytes(folder: Path) -> int:
    """Return the number of free bytes on the disk of a folder, which need not exist yet."""
    return shutil.disk_usage(_nearest_existing(folder)).free


def _nearest_existing(path: Path) -> Path:
    return next(folder for folder in (path, *path.absolute().parents) if folder.exists())


def _new_partial(parent: Path, name: str) -> Path:
    """Create `parent`, and return a temporary path in it for a file or folder that will be renamed to `name`."""
    parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned(parent.absolute())
    short_name = name.encode(errors="surrogateescape")[:_NAME_BYTES].decode(errors="ignore")
    return parent / f".{short_name}.{secrets.token_hex(4)}.partial"


@functools.cache
def remove_abandoned(folder: Path) -> None:
    """Remove from a folder the partial files that have not changed for a day. Files that cannot be removed are skipped.

    Each process scans a folder only once, because it may contain thousands of files.
    """
    with suppress(OSError):
        for path in [path for path in folder.iterdir() if _PARTIAL.fullmatch(path.name) and not path.is_symlink()]:
            with suppress(OSError):
                if time.time() - max(entry.lstat().st_mtime for entry in (path, *path.rglob("*"))) > _ABANDONED_AFTER_S:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
