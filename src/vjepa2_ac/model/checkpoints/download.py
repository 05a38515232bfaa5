"""Download of a large file over an unstable connection: resumed where it stopped, checked, then renamed."""

from __future__ import annotations

import http.client
import logging
import math
import re
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError
from vjepa2_ac.model.checkpoints.published import Published
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.storage.retries import RetryPolicy, with_retries

logger = logging.getLogger(__name__)

CHUNK_BYTES = 2**20
_POLICY = RetryPolicy(attempts=5, first_wait_s=2.0, total_s=math.inf)
_MEGABYTE, _GIGABYTE = 10**6, 10**9


@dataclass(frozen=True)
class _Download:
    """What is fetched, from where, and to where."""

    url: str
    path: Path
    known: Published | None  # what is known of the file
    reporter: Reporter

    @property
    def part(self) -> Path:
        """Where the file grows. The part of one checkpoint is not gone on with as that of another."""
        middle = "" if self.known is None or self.path.name == self.known.file else f".{self.known.name}"
        return self.path.with_name(f"{self.path.name}{middle}.part")


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
        path: Where the whole file goes; it appears there only when it is whole and checked. One that is there is
            kept, if it can be the file.
        known: The published checkpoint that it has to be, whose size and SHA-256 are checked; None: any file.
        reporter: Is told how far it is, in megabytes.
        policy: How often in a row the line may break without a byte having come, and the waits.

    Raises:
        InputError: The server does not say how large the file is, or sends another size than that or than the
            published file can have; its SHA-256 is another one; the disk has too little space; the address is none;
            the path cannot be written.
        UnreachableError: The server refuses, or cannot be reached.
    """
    what = _Download(url, Path(path), known, reporter)
    path, part = what.path, what.part
    if not re.match(r"https?://[^/?#]", url, re.IGNORECASE):
        raise _no_address(url)
    with storage.user_can_write(path):
        if path.exists():
            _require_file(what)
            return path
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        whole = with_retries(
            url,
            lambda timeout_s: _fetch(what, timeout_s),
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
    _require_hash(what, part)
    return part.replace(path)


def _fetch(what: _Download, timeout_s: float) -> int:
    """Bring the rest of a file and return the size of the whole."""
    url, part = what.url, what.part
    start = _size(part)
    try:
        request = urllib.request.Request(url, headers={"Range": f"bytes={start}-"} if start else {})  # noqa: S310  # the user's
        answer = urllib.request.urlopen(request, timeout=timeout_s)  # noqa: S310  # a URL that the user gave
    except (http.client.InvalidURL, ValueError):
        raise _no_address(url) from None
    except urllib.error.HTTPError as error:
        if error.code == 416 and error.headers.get("Content-Range", "").endswith(f"/{start}"):  # nothing is left
            _require_size(what, start, where=url)
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
        _require_size(what, whole, where=url)
        _require_space(what, whole)
        show = what.reporter.task(f"{what.path.name} (MB)")
        with storage.user_can_write(part), part.open("ab" if start else "wb") as file:
            here = start
            while block := answer.read(CHUNK_BYTES):
                file.write(block)
                here += len(block)
                show(here // _MEGABYTE, whole // _MEGABYTE)
        if here < whole:
            raise http.client.IncompleteRead(b"", whole - here)
    return whole


def _require_file(what: _Download) -> None:
    """Refuse what is at the destination, if it cannot be the file."""
    if not what.path.is_file():
        raise InputError(where=str(what.path), found="a folder", needed="the name of a file", fix="Name a file in it")
    _require_size(what, what.path.stat().st_size, where=str(what.path))
    _require_hash(what, what.path)


def _require_size(what: _Download, size: int, *, where: str) -> None:
    if what.known is None:
        return
    least, most = what.known.bytes_range
    if least <= size <= most:
        return
    exactly = f"exactly {least:,}" if least == most else f"{least:,} to {most:,}"
    if where == what.url:
        fix = (
            "Check whether a proxy answers in the server's place. If the publisher has replaced the file, fetch it by"
            f" other means, such as `curl -L -C - -o {what.path} {what.url}`"
        )
    else:
        fix = "Delete it, or name another file with --to"
    needed = f"{what.known.name}, of {exactly} bytes"
    raise InputError(where=where, found=f"a file of {size:,} bytes", needed=needed, fix=fix)


def _require_space(what: _Download, whole: int) -> None:
    """Refuse to begin if the rest of the file does not fit on the disk."""
    left, free = whole - _size(what.part), storage.free_bytes(what.path.parent.absolute())
    if left > free:
        here = f"; {_size(what.part) / _GIGABYTE:.4g} GB are here" if _size(what.part) else ""
        raise InputError(
            where=str(what.path),
            found=f"{free / _GIGABYTE:.4g} GB free on its disk",
            needed=f"{left / _GIGABYTE:.4g} GB for the rest of {whole / _GIGABYTE:.4g} GB{here}",
            fix="Free some space, or name a file on a larger disk with --to",
        )


def _require_hash(what: _Download, file: Path) -> None:
    """Refuse a whole file of another SHA-256 than the published one; one that was fetched is deleted."""
    if what.known is None or what.known.sha256 is None:
        return
    show, whole = what.reporter.task(f"SHA-256 of {what.path.name} (MB)"), _size(file)
    found = storage.sha256_of_file(file, progress=lambda done: show(done // _MEGABYTE, whole // _MEGABYTE))
    if found == what.known.sha256:
        return
    if file == what.path:
        fix = "Delete it and start again, or name another file with --to"
    else:
        file.unlink()
        fix = f"It was deleted. Start the download again; if it ends so again, {what.url} holds another file"
    raise InputError(
        where=str(file), found=f"SHA-256 {found}", needed=f"{what.known.sha256} ({what.known.name})", fix=fix
    )


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _no_address(url: str) -> InputError:
    return InputError(where=f"URL {url!r}", found="not an address", needed="one such as https://host/model.pt")
