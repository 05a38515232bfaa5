"""Atomic writes of local files: no reader ever sees an incomplete file."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator, Set
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.partial import is_partial, new_partial

_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
_UNWRITABLE = _FULL | {
    errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.ENAMETOOLONG,
    errno.EINVAL, errno.ELOOP,
}  # fmt: skip


@contextmanager
def atomic_writer(path: str | Path) -> Iterator[BinaryIO]:
    """Open a local file that gets its name, complete, when the block ends, and never if the block fails.

    Missing folders are created. The bytes are on the disk (fsync) before the file gets its name.
    """
    target = Path(path)
    with new_partial(target.parent, target.name) as temporary:
        try:
            with temporary.open("wb") as file:  # opened by name: some libraries determine the format by it
                yield file
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(target)
        except BaseException as error:
            with suppress(FileNotFoundError):
                temporary.unlink()
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
    """Yield an empty local folder to fill; its files move to `folder` when the block ends, and nowhere if it fails.

    A new folder appears complete. An existing one is not replaced (it may be the working directory, or mounted) and
    keeps its other files: the old manifest is removed first and the new one comes last, so a folder with a manifest is
    complete.

    Args:
        folder: Where the files go; missing folders are created.
        manifest: Name of the file without which the folder does not count.

    Raises:
        InputError: The folder cannot be created or written, or the disk is full.
    """
    with ExitStack() as while_writing:
        with user_can_write(folder):
            target = Path(folder).resolve()
            there = target.is_dir()
            if target.exists() and not there:
                raise NotADirectoryError(errno.ENOTDIR, "it is a file")
            parent = target if there else target.parent
            filling = while_writing.enter_context(new_partial(parent, target.name, is_folder=True))
        try:
            with user_can_write(folder, errors=_FULL):  # any other error of the block is the caller's
                yield filling
            with user_can_write(folder):
                if there:
                    _move_into(target, filling, manifest)
                else:
                    filling.replace(target)
                sync(target if there else target.parent)
        except BaseException:
            shutil.rmtree(filling, ignore_errors=True)
            raise


def is_empty(folder: Path) -> bool:
    """Return whether a folder is empty, apart from partial files of killed writers."""
    return all(map(is_partial, folder.iterdir()))


def require_new_folder(folder: Path) -> None:
    """Refuse a folder that holds something already.

    Raises:
        InputError: It does, or it cannot be looked into.
    """
    with user_can_write(folder):
        in_use = folder.is_dir() and not is_empty(folder)
    if in_use:
        raise InputError(
            where=str(folder), found="already there and not empty", fix="Delete it, or name another folder"
        )


def try_writing_at(path: Path) -> None:
    """Write a temporary file into a folder, or where it would be made. Nothing stays there.

    Raises:
        OSError: It cannot be written.
    """
    existing = next(place for place in (path, *path.absolute().parents) if place.exists())
    with tempfile.TemporaryFile(dir=existing):
        pass


def free_bytes(folder: Path) -> int:
    """Return the free bytes on the disk of a folder, which need not exist yet."""
    return shutil.disk_usage(next(there for there in [folder, *folder.parents] if there.exists())).free


@contextmanager
def user_can_write(path: str | Path, errors: Set[int] = _UNWRITABLE) -> Iterator[None]:
    """Raise an error for the user if a local path cannot be written, or the disk is full.

    Raises:
        InputError: Instead of an OSError with one of these numbers; other errors pass.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in errors:
            raise
        full = error.errno in _FULL
        fix = "Free some space, or name a place on another disk" if full else "Name a place that can be written"
        raise InputError(where=str(path), found=f"cannot be written: {error.strerror}", fix=fix) from None


def _move_into(target: Path, filled: Path, manifest: str) -> None:
    (target / manifest).unlink(missing_ok=True)
    files = [path.relative_to(filled) for path in filled.rglob("*") if path.is_file()]
    for file in sorted(files, key=lambda file: file == Path(manifest)):
        (target / file).parent.mkdir(parents=True, exist_ok=True)
        (filled / file).replace(target / file)
    shutil.rmtree(filled)


def sync(path: str | Path) -> None:
    """Make the bytes of a local file, or the names in a local folder, survive a power cut."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
