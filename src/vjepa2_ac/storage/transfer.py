"""File transfer to and from another local folder or a writable URL, and download of models from the Hub.

If a file cannot be written, a permanent failure is a `RefusedError`, any other failure an `UnreachableError`. Temporary
failures at a URL are retried. A file in an object store is either complete or absent.
"""

from __future__ import annotations

import errno
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from vjepa2_ac.errors import InputError, RefusedError, UnreachableError
from vjepa2_ac.storage import remote
from vjepa2_ac.storage.files import atomic_writer, check_local_writable, join, translate_write_errors, write_atomically
from vjepa2_ac.storage.paths import HUB, is_url
from vjepa2_ac.storage.remote import FileInfo

_TEMPORARY_ERRORS = frozenset({
    errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENOSPC,
    errno.EDQUOT,
})  # fmt: skip
_CHUNK_BYTES = 32 << 20


def upload(source: Path, target: str) -> None:
    """Copy a local file atomically to another folder or a URL, replacing an existing file.

    Raises:
        FileNotFoundError: There is no such local file.
        UnreachableError: The target cannot be written; a RefusedError if that is permanent.
    """
    if not is_url(target):
        with source.open("rb") as file, _translate_target_errors(target), atomic_writer(target) as copy:
            shutil.copyfileobj(file, copy)
        return
    try:
        remote.upload(source, target)
    except FileNotFoundError:
        if not source.is_file():
            raise
        raise _missing_bucket_error(target) from None


def write(path: str, data: bytes | str) -> None:
    """Write a local file or a URL atomically, replacing an existing file; text is written as UTF-8.

    Raises:
        InputError: The local path cannot be written, or the disk is full.
        UnreachableError: The URL cannot be written; a RefusedError if that is permanent.
    """
    if not is_url(path):
        with translate_write_errors(path):
            write_atomically(path, data)
        return
    with translate_write_errors(tempfile.gettempdir()), tempfile.NamedTemporaryFile() as source:
        source.write(data.encode() if isinstance(data, str) else data)
        source.flush()
        upload(Path(source.name), path)


def download(source: str, target: Path) -> None:
    """Copy a file from another folder or a URL to this machine, atomically, and flush it to the disk.

    Raises:
        FileNotFoundError: There is no such file.
        OSError: The source cannot be read, or the copy cannot be written.
        UnreachableError: The URL cannot be reached.
    """
    if not is_url(source):
        with Path(source).open("rb") as file, atomic_writer(target) as copy:
            shutil.copyfileobj(file, copy)
        return
    size = remote.file_size(source)
    with atomic_writer(target) as copy:
        for start in range(0, size, _CHUNK_BYTES):
            copy.write(remote.read_range(source, start, min(_CHUNK_BYTES, size - start)))


def remove(path: str) -> None:
    """Remove a file at a path or URL; a missing file is no error.

    Raises:
        UnreachableError: The file cannot be removed; a RefusedError if that is permanent.
    """
    if is_url(path):
        with suppress(FileNotFoundError):
            remote.remove(path)
        return
    with _translate_target_errors(path):
        Path(path).unlink(missing_ok=True)


def remove_folder(folder: str, *, first: str) -> None:
    """Remove all files below a folder, starting with `first`, the file that marks the folder as complete.

    Raises:
        UnreachableError: A file cannot be removed; a RefusedError if that is permanent.
    """
    remove(join(folder, first))
    for name in file_sizes(folder):
        remove(join(folder, name))
    if not is_url(folder) and Path(folder).exists():
        with _translate_target_errors(folder):
            shutil.rmtree(folder)


def file_sizes(folder: str) -> dict[str, int]:
    """Return the size in bytes of each file below a folder by its relative path; empty if there is no such folder.

    Raises:
        UnreachableError: The folder cannot be listed; a RefusedError if that is permanent.
    """
    if not is_url(folder):
        with _translate_target_errors(folder):
            sizes = dict[str, int]()
            for path in Path(folder).rglob("*"):
                with suppress(FileNotFoundError):  # a temporary file that was renamed meanwhile
                    if path.is_file():
                        sizes[path.relative_to(folder).as_posix()] = path.stat().st_size
            return sizes
    return {name: file.size for name, file in list_files_below(folder).items()}


def list_files_below(url: str) -> dict[str, FileInfo]:
    """Return all files below a folder behind a URL by their relative paths; empty if there is no such folder.

    Raises:
        UnreachableError: The folder cannot be listed; a RefusedError if that is permanent.
    """
    try:
        return remote.list_files_below(url)
    except FileNotFoundError:
        if url.startswith(("gs://", "gcs://")):  # an object store has no folders, so the bucket is missing
            raise _missing_bucket_error(url) from None
        return {}


def check_writable(folder: str) -> None:
    """Test with a temporary file whether files can be written to a folder or URL and removed from it.

    Raises:
        UnreachableError: The folder cannot be written now; a RefusedError if that is permanent.
    """
    if not is_url(folder):
        with _translate_target_errors(folder):
            check_local_writable(Path(folder))
        return
    test_file = join(folder, f".write-check-{secrets.token_hex(8)}")
    write(test_file, "This file of vjepa2-ac may be removed.\n")
    remove(test_file)


@contextmanager
def _translate_target_errors(path: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        kind = UnreachableError if error.errno in _TEMPORARY_ERRORS else RefusedError
        problem = f"cannot be written: {error.strerror or error}"
        raise kind(where=path, found=problem, fix="Check the permissions and the disk") from error


def _missing_bucket_error(url: str) -> RefusedError:
    bucket = url.partition("://")[2].split("/", 1)[0]
    return RefusedError(where=url, found=f"bucket {bucket} does not exist", fix="Create the bucket, or check its name")


def download_from_hub(name: str, files: Sequence[str], *, where: str) -> Path:
    """Download the missing files of a model on the Hub, resuming partial downloads; return its folder in the cache.

    Args:
        name: hf://owner/name, with @revision if it is not the newest.
        files: Patterns of the required files.
        where: The config key or option, for messages.

    Raises:
        RefusedError: There is no such model, or this user may not read it.
        UnreachableError: The Hub cannot be reached, and the model is not in the cache.
        InputError: The Hub returns another error, or the disk is full.
    """
    from huggingface_hub import errors, snapshot_download

    model, _, revision = name.removeprefix(HUB).partition("@")
    try:
        return Path(snapshot_download(model, revision=revision or None, allow_patterns=list(files)))
    except (errors.RepositoryNotFoundError, errors.RevisionNotFoundError):  # or gated
        fix = (
            "Check the name (hf://owner/name@revision). For a gated model, request access on its page. For a model that"
        )
        problem = "the model or revision does not exist, or you have no access"
        fix = f"{fix} is not public, run `hf auth login` or set HF_TOKEN"
        raise RefusedError(where=where, found=problem, fix=fix) from None
    except errors.LocalEntryNotFoundError:
        fix = "Check the network, or use a local folder"
        raise UnreachableError(where=where, found="the Hub cannot be reached", fix=fix) from None
    except (errors.HfHubHTTPError, OSError, ValueError) as error:
        message = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise InputError(
            where=where, found=message, needed="the files of a model", fix="Check the name and the disk"
        ) from None
