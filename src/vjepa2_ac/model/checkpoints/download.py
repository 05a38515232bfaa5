"""Download of a large file over an unstable connection: resumed where it stopped, checked, then renamed."""

from __future__ import annotations

import http.client
import math
import urllib.error
import urllib.request
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError
from vjepa2_ac.model.checkpoints.published import Published
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.storage.retries import RetryPolicy, with_retries

CHUNK_BYTES = 2**20
_POLICY = RetryPolicy(attempts=5, first_wait_s=2.0, total_s=math.inf)
_MEGABYTE = 10**6
_PROXY = "Check the URL, and whether a proxy answers in the server's place"


def download(
    url: str,
    path: str | Path,
    *,
    known: Published | None = None,
    reporter: Reporter = SILENT,
    policy: RetryPolicy = _POLICY,
) -> Path:
    """Fetch a file to `path`; a part that an earlier call left beside it is gone on with.

    Args:
        url: What to fetch.
        path: Where the whole file goes; it appears there only when it is whole. One that is there is kept, if it can
            be the file.
        known: The published checkpoint that it has to be, whose size is checked; None: any file.
        reporter: Is told how far it is, in megabytes.
        policy: How often in a row the line may break without a byte having come, and the waits.

    Raises:
        InputError: The server does not say how large the file is, or sends another size than the published file can
            have; the disk has too little space; the address is none; the path cannot be written.
        UnreachableError: The server refuses, or cannot be reached.
    """
    path = Path(path)
    if not url.lower().startswith(("http://", "https://")):
        raise _no_address(url)
    with storage.user_can_write(path):
        if path.is_dir():
            raise InputError(where=str(path), found="a folder", needed="the name of a file", fix="Name a file in it")
        if path.exists():
            _require_size(known, _size(path), where=str(path))
            return path
        path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{known.name}.part" if known else f"{path.name}.part")
    try:
        with_retries(
            url,
            lambda timeout_s: _fetch(url, part, known, reporter, timeout_s),
            policy=policy,
            access="Check the URL",
            progress=lambda: _size(part),
        )
    except RefusedError:
        raise
    except UnreachableError as error:
        found = f"{error.found}; {_size(part)} bytes are in {part}"
        fix = "Check the network and start again: it goes on where it stopped"
        raise UnreachableError(where=url, found=found, fix=fix) from None
    return part.replace(path)


def _fetch(url: str, part: Path, known: Published | None, reporter: Reporter, timeout_s: float) -> None:
    """Bring the rest of a file."""
    start = _size(part)
    try:
        request = urllib.request.Request(url, headers={"Range": f"bytes={start}-"} if start else {})  # noqa: S310  # the user's
        answer = urllib.request.urlopen(request, timeout=timeout_s)  # noqa: S310  # of http or https
    except (http.client.InvalidURL, ValueError):
        raise _no_address(url) from None
    except urllib.error.HTTPError as error:
        if error.code != 416:
            raise
        if error.headers.get("Content-Range", "").endswith(f"/{start}"):  # nothing is left
            return
        part.unlink()
        raise http.client.HTTPException("the part that is here does not fit the file; starting again") from None
    with answer:
        start = start if answer.headers.get("Content-Range", "").startswith(f"bytes {start}-") else 0
        promised = answer.headers.get("Content-Length", "")
        if not promised.isdigit():
            needed = "its size (Content-Length): without it, half a file looks like a whole one"
            raise InputError(where=url, found="a server that does not say it", needed=needed, fix=_PROXY)
        whole = start + int(promised)
        _require_size(known, whole, where=url)
        free = storage.free_bytes(part.parent.absolute()) + _size(part)
        if whole > free:
            raise InputError(
                where=str(part),
                found=f"{free / 1e9:.4g} GB free on its disk",
                needed=f"{whole / 1e9:.4g} GB, of which {start / 1e9:.4g} GB are here",
                fix="Free some space, or name a file on a larger disk with --to",
            )
        show = reporter.task(f"{part.name.removesuffix('.part')} (MB)")
        with storage.user_can_write(part), part.open("ab" if start else "wb") as file:
            while block := answer.read(CHUNK_BYTES):
                file.write(block)
                show(file.tell() // _MEGABYTE, whole // _MEGABYTE)
        if _size(part) < whole:
            raise http.client.IncompleteRead(b"", whole - _size(part))


def _require_size(known: Published | None, size: int, *, where: str) -> None:
    if known is None:
        return
    least, most = known.bytes_range
    if not least <= size <= most:
        needed = f"{known.name}, of {least:,} to {most:,} bytes"
        fix = f"{_PROXY}; or delete the file, or name another with --to"
        raise InputError(where=where, found=f"a file of {size:,} bytes", needed=needed, fix=fix)


def _no_address(url: str) -> InputError:
    return InputError(where=f"URL {url!r}", found="not an address", needed="one such as https://host/model.pt")


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
