"""Remote files: `gs://`, `hf://`, `s3://` and every other protocol of fsspec.

All network failures are handled here (see `retries`): a function returns the data, or raises FileNotFoundError (as for
a local file) or UnreachableError. All functions are safe to call from several threads and processes.
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

_THREADS = 64  # for the concurrent reads of a process
_PART_BYTES = 16 << 20  # longer reads are split into parts, each with its own time-out
_MIN_BYTES_PER_S = 1 << 20  # slowest upload; the time-out of a write is extended by its size divided by this speed
_VERSION_KEYS = ("generation", "etag", "ETag", "blob_id", "mtime", "last_modified", "LastModified", "created")

_LOGIN_COMMANDS = {"gs": "gcloud auth application-default login", "hf": "hf auth login", "s3": "aws configure"}
_EXTRAS = {"gs": "gcs", "hf": ""}  # the extra that installs the library of a protocol; empty: always installed
_SUPPORTED_LOCATIONS = "a local folder, or a gs://, hf:// or s3:// URL"
_CHAINED_PROTOCOLS = frozenset({  # fsspec protocols that wrap other file systems; some of them execute templates
    "async_wrapper", "asyncwrapper", "blockcache", "cached", "dask", "data", "dir", "filecache", "generic",
    "libarchive", "reference", "simplecache", "tar", "zip",
})  # fmt: skip
_EMULATOR = "STORAGE_EMULATOR_HOST"
_PRODUCT_NAME_FILE = Path("/sys/class/dmi/id/product_name")


_POINTER = b"version https://git-lfs.github.com/spec/v1"  # first bytes of a git-lfs pointer


class ShortReadError(OSError):
    """A file ends before the requested bytes."""


class FileInfo(NamedTuple):
    """A file or folder in a listing, on this machine or on a server."""

    name: str
    size: int  # in bytes
    version: str  # changes with the content; empty if the server has no version
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
        fix = "Run `git lfs pull` in the cloned repository to download the files"
        raise InputError(where=path, found="a git-lfs pointer", needed="the content of the file", fix=fix)


# ---- requests, with retries ----


def file_size(url: str) -> int:
    """Return the size of a file in bytes.

    Raises:
        FileNotFoundError: There is no such file.
        UnreachableError: The URL cannot be reached.
    """
    return _retry(url, lambda timeout_s: _size_once(url, timeout_s))


def file_version(url: str) -> str:
    """Return the server's version of a file, which changes with the content; empty if the server has none.

    Raises:
        FileNotFoundError: There is no such file or folder.
        UnreachableError: The URL cannot be reached.
    """
    return _version_of(_retry(url, lambda timeout_s: _call_method(url, "info", timeout_s)))


def list_folder(url: str) -> list[FileInfo]:
    """Return the entries of a folder, sorted by name; an empty list if there is no such folder.

    The server needs one request per page of the listing.

    Raises:
        UnreachableError: The URL cannot be reached.
    """
    try:
        listing = _retry(url, lambda timeout_s: _call_method(url, "ls", timeout_s, detail=True, refresh=True))
    except FileNotFoundError:
        return []
    entries = {str(entry["name"]).rstrip("/").rsplit("/", 1)[-1]: entry for entry in listing}
    return [
        FileInfo(name, int(entry.get("size") or 0), _version_of(entry), entry["type"] == "file")
        for name, entry in sorted(entries.items())
    ]


def list_files_below(url: str) -> dict[str, FileInfo]:
    """Return all files below a folder by their relative paths, from one listing that is not cached.

    Raises:
        FileNotFoundError: There is no such folder; on Google Cloud Storage, no such bucket.
        UnreachableError: The URL cannot be reached.
    """
    filesystem = _filesystem(url)
    root = filesystem._strip_protocol(url).rstrip("/") + "/"

    def find(timeout_s: float) -> Any:
        filesystem.invalidate_cache()
        return _call_filesystem(filesystem, "find", timeout_s, root, detail=True)

    entries = {name.removeprefix(root): entry for name, entry in _retry(url, find).items() if name != root}
    return {name: FileInfo(name, int(entry.get("size") or 0), _version_of(entry)) for name, entry in entries.items()}


def upload(source: Path, url: str) -> None:
    """Write a local file to a URL; folders are created on file systems that have folders.

    Raises:
        FileNotFoundError: There is no such local file; on Google Cloud Storage, no such bucket.
        UnreachableError: The URL cannot be written; a RefusedError if that is permanent.
    """
    filesystem = _filesystem(url, writing=True)
    names = (str(source), filesystem._strip_protocol(url))
    # Small chunks, because fsspec's event loop is blocked while a chunk is read from the disk.
    options = {"chunksize": _PART_BYTES} if _protocol(url) == "gs" else {}
    timeout_s = retries.DEFAULT.timeout_s + source.stat().st_size / _MIN_BYTES_PER_S
    _retry(
        url,
        lambda timeout_s: _call_filesystem(filesystem, "put_file", timeout_s, *names, **options),
        "written",
        timeout_s,
    )


def remove(url: str) -> None:
    """Remove a file.

    Raises:
        FileNotFoundError: There is no such file.
        UnreachableError: The file cannot be removed; a RefusedError if that is permanent.
    """
    _retry(url, lambda timeout_s: _call_method(url, "rm_file", timeout_s, writing=True), "written")


def read_range(url: str, start: int, length: int) -> bytes:
    """Return `length` bytes of a file from `start`; fewer only at the end of the file.

    Raises:
        FileNotFoundError: There is no such file.
        InputError: The file is a git-lfs pointer.
        UnreachableError: The URL cannot be reached.
    """
    if length > _PART_BYTES:
        end = start + length
        parts = [(begin, min(_PART_BYTES, end - begin)) for begin in range(start, end, _PART_BYTES)]
        return b"".join(_read_concurrently(url, parts))
    data = _retry(url, lambda timeout_s: _read_once(url, start, length, timeout_s)) if length > 0 else b""
    if start == 0:
        refuse_pointer(url, data)
    return data


def read_ranges(url: str, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    """Return several (start, length) ranges of a file, each complete; they are fetched concurrently.

    Raises:
        OSError: There is no such file, or it ends within a range.
        UnreachableError: The URL cannot be reached.
    """
    contents = _read_concurrently(url, ranges)
    for (start, length), content in zip(ranges, contents, strict=True):
        if len(content) < length:
            raise ShortReadError(f"{url}: {len(content)} of {length} bytes at {start}")
    return contents


def read_adjacent_ranges(url: str, ranges: Sequence[tuple[int, int]], gap_bytes: int = 0) -> list[bytes]:
    """Return several (start, length) ranges like `read_ranges`, fetching neighbouring ranges in one request.

    Args:
        url: The file.
        ranges: (start, length) ranges, ascending.
        gap_bytes: Ranges at most this far apart are fetched together with the gap between them.
    """
    groups: list[list[tuple[int, int]]] = []  # each is fetched in one request; sum(range) is the end of a range
    for start, length in ranges:
        if groups and start - sum(groups[-1][-1]) <= gap_bytes:
            groups[-1].append((start, length))
        else:
            groups.append([(start, length)])
    contents = read_ranges(url, [(group[0][0], sum(group[-1]) - group[0][0]) for group in groups])
    fetched = zip(groups, contents, strict=True)
    return [data[start - group[0][0] :][:length] for group, data in fetched for start, length in group]


def _read_concurrently(url: str, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    if len(ranges) < 2 or any(length > _PART_BYTES for _, length in ranges):
        return [read_range(url, start, length) for start, length in ranges]
    return list(_threads(os.getpid()).map(lambda bounds: read_range(url, *bounds), ranges))


def bytes_fetched() -> int:
    """Return the number of bytes that this process has fetched from URLs, including failed attempts."""
    return _fetched[0]


_fetched, _counting = [0], threading.Lock()


@lru_cache(maxsize=1)
def _threads(process: int) -> ThreadPoolExecutor:  # noqa: ARG001 - a cache key: a forked process needs new threads
    return ThreadPoolExecutor(_THREADS, thread_name_prefix="remote")


def _version_of(entry: Mapping[str, Any]) -> str:
    return next((str(entry[key]) for key in _VERSION_KEYS if entry.get(key) is not None), "")


def _read_once(url: str, start: int, length: int, timeout_s: float) -> bytes:
    """Read a range with one request; accept a short response only at the end of the file."""
    no_prefetch: Any = {} if _filesystem(url).async_impl else {"cache_type": "none"}  # the default prefetches megabytes
    try:
        data: bytes = _call_method(url, "cat_file", timeout_s, start=start, end=start + length, **no_prefetch)
    except Exception as error:
        if retries.http_status(error) != 416:
            raise
        data = b""  # HTTP 416: the file ends before `start`
    with _counting:
        _fetched[0] += len(data)
    if len(data) == length:
        return data
    available = max(0, min(start + length, _size_once(url, timeout_s)) - start)
    if len(data) != available:
        raise ConnectionError(f"{len(data)} of {available} bytes at {start}")
    return data


def _size_once(url: str, timeout_s: float) -> int:
    """Return the size of a file with one request; on Google Cloud Storage without a check for folders."""
    method = "get_object" if hasattr(_filesystem(url), "_get_object") else "info"
    return int(_call_method(url, method, timeout_s)["size"])


def _retry(url: str, action: Callable[[float], _T], operation: str = "read", timeout_s: float | None = None) -> _T:
    policy = replace(retries.DEFAULT, timeout_s=timeout_s or retries.DEFAULT.timeout_s)
    try:
        return retries.call_with_retries(url, action, policy=policy, access=login_hint(url), operation=operation)
    except NotImplementedError:
        raise RefusedError(
            where=url, found=f"{_protocol(url)}:// URLs cannot be {operation}", needed=_SUPPORTED_LOCATIONS
        ) from None


# ---- fsspec's file systems, and their credentials ----


def _call_method(url: str, method: str, timeout_s: float, *, writing: bool = False, **arguments: Any) -> Any:
    """Call a method of the URL's file system with the URL's path, without retries. Only async methods time out."""
    filesystem = _filesystem(url, writing=writing)
    return _call_filesystem(filesystem, method, timeout_s, filesystem._strip_protocol(url), **arguments)


def _call_filesystem(filesystem: Any, method: str, timeout_s: float, *arguments: Any, **options: Any) -> Any:
    if not filesystem.async_impl:
        return getattr(filesystem, method)(*arguments, **options)
    from fsspec.asyn import sync

    return sync(filesystem.loop, getattr(filesystem, f"_{method}"), *arguments, timeout=timeout_s, **options)


def login_hint(url: str) -> str:
    """Return the fix for missing permission, as a sentence."""
    protocol = _protocol(url)
    fix = (
        f"Log in with `{_LOGIN_COMMANDS[protocol]}`, or check the name"
        if protocol in _LOGIN_COMMANDS
        else "Check your login"
    )
    if protocol == "hf":
        fix += ". Or set HF_TOKEN. For a gated data set, first request access on its page"
    return f"You are not logged in. {fix}" if protocol == "gs" and google_token() == "anon" else fix


def google_token() -> str:
    """Return gcsfs' name for the available Google login: the user's default login, else the machine's, else anonymous.

    Public data sets such as DROID need no login. A local emulator never receives a login.
    """
    if os.environ.get(_EMULATOR):
        return "anon"
    folder = Path(os.environ.get("CLOUDSDK_CONFIG") or Path.home() / ".config" / "gcloud")
    if os.environ.get("GOOGLE_APPLICATION_CREDENTIALS") or (folder / "application_default_credentials.json").is_file():
        return "google_default"
    try:  # read from the firmware: a network request would take seconds on machines outside Google Cloud
        return "cloud" if _PRODUCT_NAME_FILE.read_text().startswith("Google") else "anon"
    except OSError:
        return "anon"


_filesystems: dict[tuple[object, ...], Any] = {}
_opening = threading.Lock()


def _filesystem(url: str, *, writing: bool = False) -> Any:
    """Return the file system of a URL, shared by all threads of a process (fsspec would create one per thread).

    For reading, only read access is requested, because some logins may not write.

    Raises:
        InputError: The protocol is unknown or not supported, or its library is not installed.
    """
    protocol = _protocol(url)
    with _opening:
        kind = _import_filesystem(url, protocol)
        options: dict[str, Any] = kind._get_kwargs_from_urls(url)
        if protocol == "gs":
            options["access"] = "read_write" if writing else "read_only"
        key = (os.getpid(), protocol, repr(sorted(options.items())), os.environ.get(_EMULATOR))
        if key not in _filesystems:
            try:
                filesystem = (
                    _open_google(kind, options) if protocol == "gs" else kind(**options, skip_instance_cache=True)
                )
            except TypeError as error:  # this file system needs arguments that a URL cannot contain
                raise InputError(
                    where=url,
                    found=f"{protocol}:// needs options that a URL cannot contain ({error})",
                    needed=_SUPPORTED_LOCATIONS,
                ) from None
            _filesystems[key] = filesystem
        return _filesystems[key]


def _protocol(url: str) -> str:
    protocol = url.partition("://")[0]
    return "gs" if protocol == "gcs" else protocol


def _import_filesystem(url: str, protocol: str) -> Any:
    # Set before gcsfs is imported. With its support for zonal buckets, which is on by default, the first call to each
    # bucket takes a minute if the Storage Control API does not respond.
    os.environ.setdefault("GCSFS_EXPERIMENTAL_ZB_HNS_SUPPORT", "false")
    import fsspec

    if protocol in _CHAINED_PROTOCOLS:
        raise InputError(
            where=url,
            found=f"{protocol}:// only wraps another protocol and is not supported",
            needed=_SUPPORTED_LOCATIONS,
        )
    try:
        return fsspec.get_filesystem_class(protocol)
    except ImportError as error:
        fix = f"Install it: {pip_install(_EXTRAS[protocol])}" if protocol in _EXTRAS else str(error)
        raise InputError(where=url, found=f"the library for {protocol}:// is not installed", fix=fix) from None
    except ValueError:
        raise InputError(where=url, found=f"unknown protocol {protocol}://", needed=_SUPPORTED_LOCATIONS) from None


def _open_google(kind: Any, options: dict[str, Any]) -> Any:
    """Open gcsfs without its own retries, which would add six attempts (up to 30 s) to each of `call_with_retries`."""
    request_once = getattr(kind._request, "__wrapped__", kind._request)
    open_with = partial(type(kind.__name__, (kind,), {"_request": request_once}), use_listings_cache=False, **options)
    login = google_token()
    try:
        return open_with(token=login)
    except (ValueError, OSError):
        if login != "cloud":
            raise
        return open_with(token="anon")  # noqa: S106 - a cloud machine may have no service account
