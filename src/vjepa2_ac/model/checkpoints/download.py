"""Download of a large file over an unstable connection: resumed where it stopped, its size checked, then renamed."""

from __future__ import annotations

import http.client
import logging
import math
import re
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError
from vjepa2_ac.storage.remote.retries import RetryPolicy, with_retries

logger = logging.getLogger(__name__)

OFFICIAL_URL = "https://dl.fbaipublicfiles.com/vjepa2/vjepa2-ac-vitg.pt"
OFFICIAL_LEAST_BYTES = 10 * 10**9  # it has 11.7 GB; what a proxy answers in its place has not
CHUNK_BYTES = 2**20
_POLICY = RetryPolicy(attempts=5, first_wait_s=2.0, total_s=math.inf)

Progress = Callable[[int, int], None]
"""Called with the bytes that are here and the bytes of the whole file."""


def download(
    url: str,
    path: str | Path,
    *,
    progress: Progress | None = None,
    policy: RetryPolicy = _POLICY,
) -> Path:
    """Fetch a file to `path`; a part that an earlier call left in `path.part` is gone on with.

    Args:
        url: What to fetch.
        path: Where the whole file goes; it appears there only when it is whole. One that is there is kept, if it can
            be the file.
        progress: Is told how far it is.
        policy: How often in a row the line may break without a byte having come, and the waits.

    Raises:
        InputError: The server refuses, cannot be reached, does not say how large the file is, or sends another size
            than that or than the official file can have; the address is none; the path cannot be written.
    """
    path = Path(path)
    if not re.match(r"https?://[^/?#]", url, re.IGNORECASE):
        raise _no_address(url)
    with storage.user_can_write(path):
        if path.exists():
            _require_file(url, path)
            return path
        path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    try:
        whole = with_retries(
            url,
            lambda timeout_s: _fetch(url, part, progress, timeout_s),
            policy=policy,
            access="Check the URL",
            progress=lambda: _size(part),
        )
    except RefusedError:
        raise
    except UnreachableError as error:
        here = f"{_size(part)} bytes are in {part}"
        fix = "Check the network and start again: it goes on where it stopped"
        raise UnreachableError(where=url, found=f"{error.found}; {here}", fix=fix) from None
    size = _size(part)
    if size != whole:
        part.unlink()
        raise InputError(where=url, found=f"{size} bytes", needed=f"{whole} bytes", fix="Start the download again")
    return part.replace(path)


def _fetch(url: str, part: Path, progress: Progress | None, timeout_s: float) -> int:
    """Bring the rest of a file and return the size of the whole."""
    start = _size(part)
    try:
        request = urllib.request.Request(url, headers={"Range": f"bytes={start}-"} if start else {})  # noqa: S310  # the user's
        answer = urllib.request.urlopen(request, timeout=timeout_s)  # noqa: S310  # a URL that the user gave
    except (http.client.InvalidURL, ValueError):
        raise _no_address(url) from None
    except urllib.error.HTTPError as error:
        if error.code == 416 and error.headers.get("Content-Range", "").endswith(f"/{start}"):  # nothing is left
            return start
        if error.code == 416:
            part.unlink()  # the part is not of this file
            raise http.client.HTTPException("the part that is here does not fit the file; starting again") from None
        raise
    with answer:
        resumes = answer.headers.get("Content-Range", "").startswith(f"bytes {start}-")
        if start and not (answer.status == 206 and resumes):
            logger.info("%s: the server cannot resume; starting again", url)
            start = 0
        promised = answer.headers.get("Content-Length", "")
        if not promised.isdigit():
            raise InputError(
                where=url,
                found="a server that does not say how large the file is",
                needed="its size (Content-Length): without it, half a file looks like a whole one",
                fix="Check the URL, and whether a proxy answers in its place",
            )
        whole = start + int(promised)
        _require_size(url, whole, where=url)
        with storage.user_can_write(part), part.open("ab" if start else "wb") as file:
            here = start
            while block := answer.read(CHUNK_BYTES):
                file.write(block)
                here += len(block)
                if progress:
                    progress(here, whole)
        if here < whole:
            raise http.client.IncompleteRead(b"", whole - here)
    return whole


def _require_file(url: str, path: Path) -> None:
    if not path.is_file():
        raise InputError(where=str(path), found="a folder", needed="the name of a file", fix="Name a file in it")
    _require_size(url, path.stat().st_size, where=str(path))


def _require_size(url: str, size: int, *, where: str) -> None:
    if url == OFFICIAL_URL and size < OFFICIAL_LEAST_BYTES:
        needed = f"the official checkpoint, of more than {OFFICIAL_LEAST_BYTES:,}"
        proxy, file = "Check whether a proxy answers in the server's place", "Delete it, or name another file"
        fix = proxy if where == url else file
        raise InputError(where=where, found=f"a file of {size:,} bytes", needed=needed, fix=fix)


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _no_address(url: str) -> InputError:
    return InputError(where=f"URL {url!r}", found="not an address", needed="one such as https://host/model.pt")
