"""Writing remote files: `gs://`, `s3://` and every other protocol that fsspec can write.

As in `ranged_reads`, temporary failures are retried. A file in an object store is either complete or absent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from vjepa2_ac.errors import RefusedError
from vjepa2_ac.storage.remote import retries
from vjepa2_ac.storage.remote.filesystems import ask, login_hint, send, sizes_below
from vjepa2_ac.storage.remote.retries import RetryPolicy

_T = TypeVar("_T")

_SLOWEST_BYTES_PER_S = 1 << 20  # allowed in addition to the time-out of any request


def upload_file(source: Path, url: str) -> None:
    """Write a local file to a URL, replacing any file there.

    An attempt has the policy's time-out, plus a second for each MB.

    Raises:
        FileNotFoundError: The local file does not exist.
        RefusedError: No permission, no such bucket, or the place cannot be written at all.
        UnreachableError: It cannot be reached.
    """
    allowed_s = source.stat().st_size / _SLOWEST_BYTES_PER_S
    policy = replace(retries.DEFAULT, timeout_s=retries.DEFAULT.timeout_s + allowed_s)
    try:
        _persist(url, lambda timeout_s: send(source, url, timeout_s), policy)
    except FileNotFoundError:
        if not source.is_file():
            raise
        raise _no_place(url) from None


def remove_file(url: str) -> None:
    """Remove the file of a URL; it may not exist.

    Raises:
        RefusedError: No permission.
        UnreachableError: It cannot be reached.
    """
    try:
        _persist(url, lambda timeout_s: ask(url, "rm_file", timeout_s, writing=True), retries.DEFAULT)
    except FileNotFoundError:
        return


def file_sizes(url: str) -> dict[str, int]:
    """Return the sizes of all files below a folder by their relative paths; none if there is no such folder.

    Raises:
        RefusedError: No permission, or there is no such bucket.
        UnreachableError: It cannot be reached.
    """
    try:
        return _persist(url, lambda timeout_s: sizes_below(url, timeout_s), retries.DEFAULT, doing="read")
    except FileNotFoundError:
        if url.startswith(("gs://", "gcs://")):  # which has no folders: only buckets can be missing
            raise _no_place(url) from None
        return {}


def _persist(url: str, action: Callable[[float], _T], policy: RetryPolicy, doing: str = "written") -> _T:
    try:
        return retries.with_retries(url, action, policy=policy, access=login_hint(url), doing=doing)
    except NotImplementedError:
        found = f"{url.partition('://')[0]}:// cannot be written"
        raise RefusedError(where=url, found=found, needed="a folder of this machine, gs:// or s3://") from None


def _no_place(url: str) -> RefusedError:
    bucket = url.partition("://")[2].split("/", 1)[0]
    return RefusedError(where=url, found=f"there is no bucket {bucket}", fix="Make it, or check its name")
