"""Remote files: `gs://`, `hf://`, `s3://` and every other protocol of fsspec.

All network failures are handled here (see `retries`): the result is the data, FileNotFoundError as from a disk, or
UnreachableError. Every function may be called from many threads, and in every process.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from vjepa2_ac.errors import InputError, RefusedError, pip_install
from vjepa2_ac.storage import retries

_T = TypeVar("_T")

_THREADS = 64  # concurrent reads of `read_ranges` in a process
_PIECE_BYTES = 16 << 20  # longer reads are split: each piece has the full time-out
_SLOWEST_BYTES_PER_S = 1 << 20  # when writing: allowed in addition to the time-out of any request
_VERSION_KEYS = ("generation", "etag", "ETag", "blob_id", "mtime", "last_modified", "LastModified", "created")

_LOG_IN = {"gs": "gcloud auth application-default login", "hf": "hf auth login", "s3": "aws configure"}
_EXTRAS = {"gs": "gcs", "hf": ""}  # the second: every installation
_KNOWN = "a folder of this machine, or gs://, hf://, s3://"
_NO_PLACES = frozenset({  # they lead to other file systems, some by templates that are executed
    "async_wrapper", "asyncwrapper", "blockcache", "cached", "dask", "data", "dir", "filecache", "generic",
    "libarchive", "reference", "simplecache", "tar", "zip",
})  # fmt: skip
_EMULATOR = "STORAGE_EMULATOR_HOST"
_MACHINE = Path("/sys/class/dmi/id/product_name")


_POINTER = b"version https://git-lfs.github.com/spec/v1"  # the beginning of what git-lfs commits in place of a file


class ShortReadError(OSError):
    """A file ends before the requested bytes."""


class FileInfo(NamedTuple):
    """A file or folder in a listing, on this machine or at a server."""

    name: str
    size: int
    version: str  # changes with the content, as far as is known without reading it
    is_file: bool = True


def refuse_pointer(path: str, beginning: bytes) -> None:
    """Refuse a git-lfs pointer in place of a file.

    Args:
        path: The file.
        beginning: The first bytes of the file.

    Raises:
        InputError: The file is a pointer.
    """
    if beginning.startswith(_POINTER):
        fix = "Run `git lfs pull` in the cloned repository, which downloads the files"
        raise InputError(where=path, found="a git-lfs pointer", needed="the file that it stands for", fix=fix)


# ---- requests, with retries ----


def file_size(url: str) -> int:
    """Return the size of a file in bytes.

    Raises:
        FileNotFoundError: There is no such file.
        UnreachableError: It cannot be reached.
    """
    return _persist(url, lambda timeout_s: _size_once(url, timeout_s))


def file_version(url: str) -> str:
    """Return the server's version of a file's content, which changes with the content; empty where there is none.

    Raises:
        FileNotFoundError: There is no such file or folder.
        UnreachableError: It cannot be reached.
    """
    return _version_of(_persist(url, lambda timeout_s: _ask(url, "info", timeout_s)))


def list_folder(url: str) -> list[FileInfo]:
    """Return the entries of a folder, sorted by name: one listing, one call per page; none if there is no such folder.

    Raises:
        UnreachableError: It cannot be reached.
    """
    try:
        listed = _persist(url, lambda timeout_s: _ask(url, "ls", timeout_s, detail=True, refresh=True))
    except FileNotFoundError:
        return []
    names = {str(found["name"]).rstrip("/").rsplit("/", 1)[-1]: found for found in listed}
    return [
        FileInfo(name, int(found.get("size") or 0), _version_of(found), found["type"] == "file")
        for name, found in sorted(names.items())
    ]


def files_below(url: str) -> dict[str, FileInfo]:
    """Return all files below a folder by their relative paths: one listing, one request per page, not cached.

    Raises:
        FileNotFoundError: There is no such folder; of Google's, no such bucket.
        UnreachableError: It cannot be reached.
    """
    filesystem = _filesystem(url)
    root = filesystem._strip_protocol(url).rstrip("/") + "/"

    def find(timeout_s: float) -> Any:
        filesystem.invalidate_cache()
        return _once(filesystem, "find", timeout_s, root, detail=True)

    found = _persist(url, find)
    names = {name.removeprefix(root): about for name, about in found.items() if name != root}
    return {name: FileInfo(name, int(about.get("size") or 0), _version_of(about)) for name, about in names.items()}


def send(source: Path, url: str) -> None:
    """Write a local file to a URL; folders are created where the file system has them.

    Raises:
        FileNotFoundError: There is no such local file; of Google's, no such bucket.
        UnreachableError: It cannot be written; a RefusedError if that is permanent.
    """
    filesystem = _filesystem(url, writing=True)
    names = (str(source), filesystem._strip_protocol(url))
    pieces = {"chunksize": _PIECE_BYTES} if _protocol(url) == "gs" else {}  # a piece is read while other reads wait
    allowed_s = retries.DEFAULT.timeout_s + source.stat().st_size / _SLOWEST_BYTES_PER_S
    _persist(url, lambda timeout_s: _once(filesystem, "put_file", timeout_s, *names, **pieces), "written", allowed_s)


def remove(url: str) -> None:
    """Remove a file.

    Raises:
        FileNotFoundError: There is no such file.
        UnreachableError: It cannot be removed; a RefusedError if that is permanent.
    """
    _persist(url, lambda timeout_s: _ask(url, "rm_file", timeout_s, writing=True), "written")


def read_range(url: str, start: int, length: int) -> bytes:
    """Return `length` bytes from `start`; fewer only if the file ends.

    Raises:
        FileNotFoundError: There is no such file.
        InputError: It is a git-lfs pointer.
        UnreachableError: It cannot be reached.
    """
    if length > _PIECE_BYTES:
        cuts = range(start, start + length, _PIECE_BYTES)
        return b"".join(_concurrently(url, [(cut, min(_PIECE_BYTES, start + length - cut)) for cut in cuts]))
    data = _persist(url, lambda timeout_s: _read_once(url, start, length, timeout_s)) if length > 0 else b""
    if start == 0:
        refuse_pointer(url, data)
    return data


def read_ranges(url: str, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    """Return several (start, length) pieces of a file, each complete; they are fetched concurrently.

    Raises:
        OSError: There is no such file, or it ends within a piece.
        UnreachableError: It cannot be reached.
    """
    pieces = _concurrently(url, ranges)
    for (start, length), piece in zip(ranges, pieces, strict=True):
        if len(piece) < length:
            raise ShortReadError(f"{url}: {len(piece)} of {length} bytes at {start}")
    return pieces


def read_neighbours(url: str, ranges: Sequence[tuple[int, int]], gap_bytes: int = 0) -> list[bytes]:
    """Return several (start, length) pieces as `read_ranges`; those at most `gap_bytes` apart are fetched together.

    Args:
        url: The file.
        ranges: Ascending.
        gap_bytes: Such a gap is fetched, too.
    """
    runs: list[list[tuple[int, int]]] = []
    for start, length in ranges:
        if runs and start - sum(runs[-1][-1]) <= gap_bytes:
            runs[-1].append((start, length))
        else:
            runs.append([(start, length)])
    fetched = read_ranges(url, [(run[0][0], sum(run[-1]) - run[0][0]) for run in runs])
    pieces = zip(runs, fetched, strict=True)
    return [data[start - run[0][0] :][:length] for run, data in pieces for start, length in run]


def _concurrently(url: str, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    if len(ranges) < 2 or any(length > _PIECE_BYTES for _, length in ranges):
        return [read_range(url, start, length) for start, length in ranges]
    return list(_threads(os.getpid()).map(lambda piece: read_range(url, *piece), ranges))


def bytes_fetched() -> int:
    """Return how many bytes of files this process has read so far, including failed attempts."""
    return _fetched[0]


_fetched, _counting = [0], threading.Lock()


@lru_cache(maxsize=1)
def _threads(process: int) -> ThreadPoolExecutor:  # noqa: ARG001 - threads do not survive a fork
    return ThreadPoolExecutor(_THREADS, thread_name_prefix="remote")


def _version_of(found: Mapping[str, Any]) -> str:
    return next((str(found[key]) for key in _VERSION_KEYS if found.get(key) is not None), "")


def _read_once(url: str, start: int, length: int, timeout_s: float) -> bytes:
    """Read a range; accept a short answer only at the end of the file."""
    bare: Any = {} if _filesystem(url).async_impl else {"cache_type": "none"}  # else megabytes are prefetched
    try:
        data: bytes = _ask(url, "cat_file", timeout_s, start=start, end=start + length, **bare)
    except Exception as error:
        if retries.status_of(error) != 416:
            raise
        data = b""  # the server has nothing at `start`
    with _counting:
        _fetched[0] += len(data)
    if len(data) == length:
        return data
    there = max(0, min(start + length, _size_once(url, timeout_s)) - start)
    if len(data) != there:
        raise ConnectionError(f"{len(data)} of {there} bytes at {start}")
    return data


def _size_once(url: str, timeout_s: float) -> int:
    """Return the size of a file, with one request; at Google without checking whether it is a folder."""
    method = "get_object" if hasattr(_filesystem(url), "_get_object") else "info"
    return int(_ask(url, method, timeout_s)["size"])


def _persist(url: str, action: Callable[[float], _T], doing: str = "read", timeout_s: float | None = None) -> _T:
    policy = replace(retries.DEFAULT, timeout_s=timeout_s or retries.DEFAULT.timeout_s)
    try:
        return retries.with_retries(url, action, policy=policy, access=login_hint(url), doing=doing)
    except NotImplementedError:
        raise RefusedError(where=url, found=f"{_protocol(url)}:// cannot be {doing}", needed=_KNOWN) from None


# ---- fsspec's file systems, and their credentials ----


def _ask(url: str, method: str, timeout_s: float, *, writing: bool = False, **arguments: Any) -> Any:
    """Call a method of the URL's file system with the URL's path, once; with a time-out where that is possible."""
    filesystem = _filesystem(url, writing=writing)
    return _once(filesystem, method, timeout_s, filesystem._strip_protocol(url), **arguments)


def _once(filesystem: Any, method: str, timeout_s: float, *arguments: Any, **options: Any) -> Any:
    if not filesystem.async_impl:
        return getattr(filesystem, method)(*arguments, **options)
    from fsspec.asyn import sync

    return sync(filesystem.loop, getattr(filesystem, f"_{method}"), *arguments, timeout=timeout_s, **options)


def login_hint(url: str) -> str:
    """Return what to do when permission is missing, as a sentence."""
    protocol = _protocol(url)
    log_in = f"Log in with `{_LOG_IN[protocol]}`, or check the name" if protocol in _LOG_IN else "Check the login"
    if protocol == "hf":
        log_in += ". Or set HF_TOKEN. A gated data set must be asked for on its page first"
    return f"You are not logged in. {log_in}" if protocol == "gs" and google_token() == "anon" else log_in


def google_token() -> str:
    """Return the kind of Google login: the user's default login if there is one, else the machine's, else anonymous.

    DROID needs no login. A local emulator never receives one.
    """
    if os.environ.get(_EMULATOR):
        return "anon"
    folder = Path(os.environ.get("CLOUDSDK_CONFIG") or Path.home() / ".config" / "gcloud")
    if os.environ.get("GOOGLE_APPLICATION_CREDENTIALS") or (folder / "application_default_credentials.json").is_file():
        return "google_default"
    try:  # the firmware says so: a network request would take seconds on any other machine
        return "cloud" if _MACHINE.read_text().startswith("Google") else "anon"
    except OSError:
        return "anon"


_filesystems: dict[tuple[object, ...], Any] = {}
_opening = threading.Lock()


def _filesystem(url: str, *, writing: bool = False) -> Any:
    """Return the file system of a URL: one for all threads of a process; fsspec would create one for each.

    Readers request read access only: some logins may not write.

    Raises:
        InputError: The library for it is not installed, or there is none.
    """
    protocol = _protocol(url)
    with _opening:
        kind = _kind(url, protocol)
        options: dict[str, Any] = kind._get_kwargs_from_urls(url)
        if protocol == "gs":
            options["access"] = "read_write" if writing else "read_only"
        key = (os.getpid(), protocol, repr(sorted(options.items())), os.environ.get(_EMULATOR))
        if key not in _filesystems:
            try:
                opened = _google(kind, options) if protocol == "gs" else kind(**options, skip_instance_cache=True)
            except TypeError as error:  # it needs more than an address
                raise InputError(where=url, found=f"an address alone does not do ({error})", needed=_KNOWN) from None
            _filesystems[key] = opened
        return _filesystems[key]


def _protocol(url: str) -> str:
    protocol = url.partition("://")[0]
    return "gs" if protocol == "gcs" else protocol


def _kind(url: str, protocol: str) -> Any:
    # Before gcsfs is imported: its support for zonal buckets, on by default, makes the first call to each bucket wait
    # for a minute where the Storage Control API does not answer.
    os.environ.setdefault("GCSFS_EXPERIMENTAL_ZB_HNS_SUPPORT", "false")
    import fsspec

    if protocol in _NO_PLACES:
        raise InputError(where=url, found=f"{protocol}://, which is no place but a way to another", needed=_KNOWN)
    try:
        return fsspec.get_filesystem_class(protocol)
    except ImportError as error:
        fix = f"Install it: {pip_install(_EXTRAS[protocol])}" if protocol in _EXTRAS else str(error)
        raise InputError(where=url, found=f"the library for {protocol}:// is not installed", fix=fix) from None
    except ValueError:
        raise InputError(where=url, found=f"nothing reads {protocol}://", needed=_KNOWN) from None


def _google(kind: Any, options: dict[str, Any]) -> Any:
    """Open Google's file system without its own retries: six for each of ours, up to half a minute in total."""
    once = getattr(kind._request, "__wrapped__", kind._request)
    open_as = partial(type(kind.__name__, (kind,), {"_request": once}), use_listings_cache=False, **options)
    who = google_token()
    try:
        return open_as(token=who)
    except (ValueError, OSError):
        if who != "cloud":
            raise
        return open_as(token="anon")  # noqa: S106 - a machine may have no account of its own
