"""The planning server: a websocket for one robot at a time; health and counters over HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import http
import ssl
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from vjepa2_ac.errors import require_library
from vjepa2_ac.serving.access import Access, ends, listen, single_header, until_signalled, url_of
from vjepa2_ac.serving.session import Counts, GoneError, Session
from vjepa2_ac.serving.wire import MOST_BYTES, pack

_OPEN_S = 10.0  # that a handshake may take
_WAITING = 2  # messages of a client that are read before they are answered


@dataclass(frozen=True)
class ServerOptions:
    """Where and for whom a server listens."""

    access: Access
    port: int = 8000  # 0: a free one
    certificate: ssl.SSLContext | None = None  # None: no TLS
    ping_s: float = 20.0  # between pings; a client that does not answer one for as long is gone


@dataclass(frozen=True)
class Served:
    """What is served, once it is loaded."""

    session: Session
    metadata: Mapping[str, Any]


class PlanningServer:
    """Serves a planner to one robot at a time."""

    def __init__(self, load: Callable[[], Served], options: ServerOptions, tell: Callable[[str], None]) -> None:
        """Prepare; nothing is loaded yet.

        Args:
            load: Loads the model and makes a first decision; runs in the planning thread while the server listens.
            options: Where it listens, and for whom.
            tell: Takes a line for whoever started it.
        """
        self._load, self._options, self._tell = load, options, tell
        self._planning = ThreadPoolExecutor(1, "planning")
        self._served: Served | None = None
        self._ready = asyncio.Event()
        self._robot: str | None = None  # the address of the one that is served
        self._turned_away: Counter[str] = Counter()  # by HTTP status

    async def run(self, stop: asyncio.Event) -> bool:
        """Listen until `stop`; return whether the planning thread has ended, too.

        Raises:
            InputError: What is to be served cannot be loaded, or the address cannot be listened on.
        """
        library = require_library("websockets.asyncio.server", where="serve", called="websockets", extra="serve")
        options = self._options
        server = await listen(
            library,
            self._robot_came,
            options.access,
            options.port,
            process_request=self._asked,
            max_size=MOST_BYTES,
            max_queue=_WAITING,
            open_timeout=_OPEN_S,
            ping_interval=options.ping_s,
            ping_timeout=options.ping_s,
            ssl=options.certificate,
        )
        try:
            self._tell(f"listening on {url_of(server, 'ws' if options.certificate is None else 'wss')}")
            await self._serve(stop)
        finally:
            server.close()  # its clients are gone, which ends what is computed for them
            last = asyncio.wrap_future(self._planning.submit(int))
            self._planning.shutdown(wait=False)
            has_ended = await ends(server.wait_closed(), last)
        return has_ended

    async def _serve(self, stop: asyncio.Event) -> None:
        loading = asyncio.wrap_future(self._planning.submit(self._load))
        stopping = asyncio.ensure_future(stop.wait())
        await _first_of(loading, stopping)
        if stop.is_set():
            return
        self._served = loading.result()
        self._ready.set()
        self._tell("ready")
        await stopping

    def _asked(self, connection: Any, request: Any) -> Any:
        """Answer what comes over HTTP, and refuse who may not come in; None: a robot may begin."""
        path, status = request.path.partition("?")[0], http.HTTPStatus
        host, authorization = (single_header(request, name) for name in ("Host", "Authorization"))
        if path == "/healthz":
            return connection.respond(status.OK, "OK\n")
        if path == "/readyz":
            is_ready = self._ready.is_set()
            return connection.respond(
                status.OK if is_ready else status.SERVICE_UNAVAILABLE, "ready\n" if is_ready else "loading\n"
            )
        refused = self._options.access.why_not(host, authorization)
        if refused is None and path == "/metrics":
            return connection.respond(status.OK, self._metrics())
        if refused is None and path != "/":
            return connection.respond(status.NOT_FOUND, "no such page\n")
        if refused is None and request.headers.get_all("Upgrade"):
            if request.headers.get_all("Origin"):
                refused = status.FORBIDDEN.value, "a page in a browser moves no robot"
            elif self._robot is not None:
                refused = status.SERVICE_UNAVAILABLE.value, _busy(self._robot)
        if refused is None:
            return None
        self._turned_away[str(refused[0])] += 1
        return connection.respond(status(refused[0]), f"{refused[1]}\n")

    async def _robot_came(self, connection: Any) -> None:
        """Serve a robot until it leaves; one that comes before the model is loaded waits."""
        if self._robot is not None:  # both came at once
            await connection.close(1013, _busy(self._robot)[:100])
            return
        self._robot = _name(connection)
        left = asyncio.ensure_future(connection.wait_closed())
        try:
            await _first_of(left, ready := asyncio.ensure_future(self._ready.wait()))
            ready.cancel()
            if self._served is not None and not left.done():
                await self._serve_robot(connection, left, self._served)
        finally:
            self._robot = None
            left.cancel()

    async def _serve_robot(self, connection: Any, left: asyncio.Future[None], served: Served) -> None:
        self._tell(f"{self._robot} is here")
        await asyncio.wrap_future(self._planning.submit(served.session.begin))
        closed = require_library("websockets.exceptions", where="serve", called="websockets", extra="serve")
        with contextlib.suppress(closed.ConnectionClosed):
            await connection.send(pack(served.metadata))
            async for message in connection:
                if isinstance(message, str):
                    await connection.send("a request is a binary message, in msgpack")
                    continue
                answer = await self._answer(message, left, served.session)
                if answer is None:
                    break
                await connection.send(answer)
        self._tell(f"{self._robot} has left")

    async def _answer(self, message: bytes, left: asyncio.Future[None], session: Session) -> bytes | str | None:
        """Return the answer to a message; None: the robot has left, and its search ends within an iteration."""
        gone = threading.Event()
        answering = asyncio.wrap_future(self._planning.submit(lambda: session.answer(message, gone.is_set)))
        try:
            await _first_of(answering, left)
        finally:
            if not answering.done():
                gone.set()
        try:
            return await answering
        except GoneError:
            return None

    def _metrics(self) -> str:
        """Return the counters in Prometheus' text format."""
        counts = Counts() if self._served is None else self._served.session.counts
        values = {
            "ready": int(self._ready.is_set()),
            "robots": int(self._robot is not None),
            "requests_refused_total": counts.refused,
            "requests_failed_total": counts.failed,
            "episodes_total": counts.episodes,
            "alarms_total": counts.alarms,
            "surprise": counts.surprise,
            "decision_seconds_sum": counts.seconds,
            "decision_seconds_count": counts.decisions.total(),
            **{f'decisions_total{{why="{why}"}}': number for why, number in sorted(counts.decisions.items())},
            **{f'connections_refused_total{{status="{one}"}}': n for one, n in sorted(self._turned_away.items())},
        }
        return "".join(f"vjepa2_ac_{name} {value}\n" for name, value in values.items())


def serve(load: Callable[[], Served], options: ServerOptions, tell: Callable[[str], None]) -> bool:
    """Serve until SIGTERM or SIGINT; return whether the planning thread has ended, too.

    Raises:
        InputError: As `PlanningServer.run`.
    """
    return until_signalled(PlanningServer(load, options, tell).run)


async def _first_of(*futures: asyncio.Future[Any]) -> None:
    await asyncio.wait(futures, return_when=asyncio.FIRST_COMPLETED)


def _busy(robot: str) -> str:
    return f"busy: a robot at {robot} is being served, and one server moves one robot"


def _name(connection: Any) -> str:
    address = connection.remote_address
    return f"{address[0]}:{address[1]}" if isinstance(address, tuple) else "an unknown address"
