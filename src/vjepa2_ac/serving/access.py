"""Access rules and listening address of a websocket server. The headers of a request decide, before any message."""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import re
import shlex
import signal
import stat
import threading
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from vjepa2_ac.errors import InputError

logger = logging.getLogger(__name__)

MIN_KEY_CHARACTERS = 16
SHUTDOWN_TIMEOUT_S = 1.5  # how long a stopping server waits for connections and computations
_Result = TypeVar("_Result")
_HOST = re.compile(r"(?:\[([0-9a-f:.]+)\]|([^\[\]:]+))(?::[0-9]*)?|([0-9a-f:]+)")  # [address]:port, name:port, address
_SCHEMES = ("api-key", "bearer")  # openpi's clients send api-key


@dataclass(frozen=True)
class Access:
    """The access rules of a server.

    Raises:
        InputError: Other machines can reach the address, and there is neither a key nor `is_insecure`.
    """

    host: str  # the address to listen on
    key: str | None = None  # the key that a client must send
    is_insecure: bool = False  # whether no key is required although other machines can reach the address
    names: Collection[str] = ()  # further host names, for example of a proxy

    def __post_init__(self) -> None:
        if not is_loopback(self.host) and self.key is None and not self.is_insecure:
            problem = "other machines can reach this address, and no key is set, so any of them could move the robot"
            needed = "--key-file FILE with the key that clients send, or --host 127.0.0.1"
            fix = "Use --insecure only in a network in which every machine may move the robot"
            raise InputError(where=f"--host {self.host}", found=problem, needed=needed, fix=fix)

    def find_rejection(self, host: str | None, authorization: str | None) -> tuple[int, str] | None:
        """Return the HTTP status and the reason for which a request is rejected; None if it is accepted.

        Args:
            host: The header `Host`. An unknown name is rejected, because a web page can resolve its own name to this
                machine (DNS rebinding).
            authorization: The header `Authorization`.
        """
        if not self._is_known_host(host):
            return 403, "unknown host name in the request; start the server with --allow-host NAME to accept it"
        if self.key is not None and not self._has_key(authorization):
            return 401, "a valid key is required; send the header `Authorization: Api-Key KEY`"
        return None

    def _is_known_host(self, host: str | None) -> bool:
        """Return whether the header `Host` is an IP address or one of this server's names."""
        match = _HOST.fullmatch((host or "").strip().lower())
        if match is None:
            return False
        name = match[1] or match[2] or match[3]
        known_names = {"localhost", self.host.lower(), *(known_name.lower() for known_name in self.names)}
        return name in known_names or _parse_address(name) is not None

    def _has_key(self, authorization: str | None) -> bool:
        scheme, _, key = (authorization or "").partition(" ")
        expected = (self.key or "").encode()
        is_same = hmac.compare_digest(key.strip().encode(errors="surrogateescape"), expected)
        return is_same and scheme.lower() in _SCHEMES


def read_key(path: Path) -> str:
    """Return the key in the first line of a file.

    Raises:
        InputError: The file cannot be read, or the key is too short or contains characters that are not allowed.
    """
    try:
        text = path.read_text(encoding="ascii")
        mode = path.stat().st_mode
    except (OSError, UnicodeDecodeError) as error:
        problem = error.strerror if isinstance(error, OSError) else "characters that are not ASCII"
        raise InputError(
            where=f"--key-file {path}", found=str(problem), needed="a text file with a key in the first line"
        ) from None
    key = text.partition("\n")[0].strip()
    if len(key) < MIN_KEY_CHARACTERS or not key.isprintable() or " " in key:
        problem = f"the first line is no valid key ({len(key)} characters)"
        fix = f"Create a key: python -c 'import secrets; print(secrets.token_urlsafe())' > {shlex.quote(str(path))}"
        needed = f"a key of at least {MIN_KEY_CHARACTERS} printable ASCII characters without spaces"
        raise InputError(where=f"--key-file {path}", found=problem, needed=needed, fix=fix)
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        logger.warning(
            "other users of this machine can read the key in %s. Restrict the access: chmod 600 %s",
            path,
            shlex.quote(str(path)),
        )
    return key


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach an address. Names except `localhost` return false."""
    address = _parse_address(host)
    return host == "localhost" or (address is not None and address.is_loopback)


def _parse_address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def get_single_header(request: Any, name: str) -> str | None:
    """Return the value of a header; None if the request does not contain it exactly once."""
    values = request.headers.get_all(name)
    return values[0] if len(values) == 1 else None


@contextmanager
def translate_listen_errors(access: Access, port: int) -> Iterator[None]:
    """Convert an OSError in a `with` block into an error that contains the address.

    Raises:
        InputError: The server cannot listen on the address.
    """
    try:
        yield
    except OSError as error:
        where, fix = f"{access.host}:{port}", "Choose another port, or --port 0 for a free one"
        raise InputError(where=where, found=f"the server cannot listen ({error.strerror or error})", fix=fix) from None


def format_url(server: Any, scheme: str) -> str:
    """Return the URL at which a server listens."""
    host, port = server.sockets[0].getsockname()[:2]
    return f"{scheme}://{f'[{host}]' if ':' in str(host) else host}:{port}"


async def wait_for_shutdown(*awaitables: Awaitable[Any]) -> bool:
    """Wait for awaitables, at most `SHUTDOWN_TIMEOUT_S` seconds; return whether all have finished."""
    _, pending = await asyncio.wait([asyncio.ensure_future(item) for item in awaitables], timeout=SHUTDOWN_TIMEOUT_S)
    return not pending


def run_until_signal(run: Callable[[asyncio.Event], Coroutine[Any, Any, _Result]]) -> _Result:
    """Run a coroutine with an event that SIGTERM and SIGINT set, and return its result.

    Outside the main thread, signals are not handled.
    """

    async def run_with_signals() -> _Result:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                loop.add_signal_handler(number, stop.set)
        return await run(stop)

    return asyncio.run(run_with_signals())
