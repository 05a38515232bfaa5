"""The fsspec file system for a URL, and its credentials."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

from vjepa2_ac.errors import InputError, pip_install

GOOGLE = frozenset({"gs", "gcs"})

_LOG_IN = {"gs": "gcloud auth application-default login", "hf": "hf auth login", "s3": "aws configure"}
_EXTRAS = {"gs": "gcs", "hf": ""}  # the second: every installation
_KNOWN = "a folder of this machine, or gs://, hf://, s3://"
_NO_PLACES = frozenset({  # they lead to other file systems, some by templates that are executed
    "async_wrapper", "asyncwrapper", "blockcache", "cached", "dask", "data", "dir", "filecache", "generic",
    "libarchive", "reference", "simplecache", "tar", "zip",
})  # fmt: skip
_EMULATOR = "STORAGE_EMULATOR_HOST"
_MACHINE = Path("/sys/class/dmi/id/product_name")
_PIECE_BYTES = 16 << 20  # of an upload; it is read while other reads wait


def ask(url: str, method: str, timeout_s: float, *, writing: bool = False, **arguments: Any) -> Any:
    """Call a method of the URL's file system with the URL's path, once; with a time-out where that is possible.

    Args:
        url: What it is about.
        method: Its name.
        timeout_s: The time-out.
        writing: Whether it changes something: only then is permission to do so requested.
        arguments: Others of the method.

    Raises:
        Exception: Whatever the library raises.
        InputError: The library is not installed, or does not exist.
    """
    filesystem = _filesystem(url, writing=writing)
    return _once(filesystem, method, timeout_s, filesystem._strip_protocol(url), **arguments)


def send(source: Path, url: str, timeout_s: float) -> None:
    """Write a local file to a URL, once; folders are created where the file system has them.

    Raises:
        Exception: Whatever the library raises.
        InputError: As `ask`.
    """
    filesystem = _filesystem(url, writing=True)
    pieces = {"chunksize": _PIECE_BYTES} if _protocol(url) == "gs" else {}
    _once(filesystem, "put_file", timeout_s, str(source), filesystem._strip_protocol(url), **pieces)


def sizes_below(url: str, timeout_s: float) -> dict[str, int]:
    """Return the sizes of all files below a folder by their relative paths; one request, not cached.

    Raises:
        Exception: Whatever the library raises.
        InputError: As `ask`.
    """
    filesystem = _filesystem(url)
    filesystem.invalidate_cache()
    root = filesystem._strip_protocol(url).rstrip("/") + "/"
    found = _once(filesystem, "find", timeout_s, root, detail=True)
    return {name.removeprefix(root): int(about.get("size") or 0) for name, about in found.items() if name != root}


def _once(filesystem: Any, method: str, timeout_s: float, *arguments: Any, **options: Any) -> Any:
    if not filesystem.async_impl:
        return getattr(filesystem, method)(*arguments, **options)
    from fsspec.asyn import sync

    return sync(filesystem.loop, getattr(filesystem, f"_{method}"), *arguments, timeout=timeout_s, **options)


def size_of(url: str, timeout_s: float) -> int:
    """Return the size of a file, with one request; at Google without checking whether it is a folder.

    Raises:
        Exception: Whatever the library raises.
    """
    method = "get_object" if hasattr(_filesystem(url), "_get_object") else "info"
    return int(ask(url, method, timeout_s)["size"])


def is_asynchronous(url: str) -> bool:
    """Return whether the URL's file system is asynchronous: it reads exact ranges, and supports time-outs."""
    return bool(_filesystem(url).async_impl)


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
    return "cloud" if _is_google_machine() else "anon"


def _is_google_machine() -> bool:
    """Check the firmware: a network request would take seconds on any other machine."""
    try:
        return _MACHINE.read_text().startswith("Google")
    except OSError:
        return False


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
            _filesystems[key] = _google(kind, options) if protocol == "gs" else _plain(kind, options, url)
        return _filesystems[key]


def _protocol(url: str) -> str:
    protocol = url.partition("://")[0]
    return "gs" if protocol in GOOGLE else protocol


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
        extra = _EXTRAS.get(protocol)
        fix = str(error) if extra is None else f"Install it: {pip_install(extra)}"
        raise InputError(where=url, found=f"the library for {protocol}:// is not installed", fix=fix) from None
    except ValueError:
        raise InputError(where=url, found=f"nothing reads {protocol}://", needed=_KNOWN) from None


def _plain(kind: Any, options: dict[str, Any], url: str) -> Any:
    try:
        return kind(**options, skip_instance_cache=True)
    except TypeError as error:  # it needs more than an address
        raise InputError(where=url, found=f"an address alone does not do ({error})", needed=_KNOWN) from None


def _google(kind: Any, options: dict[str, Any]) -> Any:
    """Open Google's file system without its own retries: six for each of ours, up to half a minute in total."""
    once = getattr(kind._request, "__wrapped__", kind._request)
    kind = type(kind.__name__, (kind,), {"_request": once})
    options = {"use_listings_cache": False, **options}
    who = google_token()
    if who == "cloud":  # a machine may have no account of its own
        try:
            return kind(token=who, **options)
        except (ValueError, OSError):
            who = "anon"
    return kind(token=who, **options)
