"""The server: a websocket for one robot at a time, health and figures over HTTP. It plans in a thread of its own."""

from __future__ import annotations

import asyncio
import contextlib
import http
import signal
import ssl
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from vjepa2_ac.errors import require_library
from vjepa2_ac.serving.access import Access
from vjepa2_ac.serving.listening import ends, listen, until_signalled, url_of
from vjepa2_ac.serving.pages import Page, single_header
from vjepa2_ac.serving.session import Counts, GoneError
from vjepa2_ac.serving.wire import MOST_BYTES, pack

if TYPE_CHECKING:  # PyTorch is imported with the model, when the server listens
    from vjepa2_ac.serving.session import Session

_OPEN_S = 10.0  # that a handshake may take
_WAITING = 2  # messages of a client that are read before they are answered


class Watcher(Protocol):
    """A page that shows what is served, beside the robot's own path."""

    page: Page

    def begin(self, session: Session, robot: Callable[[], str | None]) -> None:
        """Watch a session, once it is loaded, and know the address of the robot that is served, if one is."""

    async def show(self, connection: Any) -> None:
        """Show it to a page, until that is closed."""


@dataclass(frozen=True)
class ServerOptions:
    """Where and for whom a server listens."""

    access: Access
    port: int = 8000  # 0: a free one
    certificate: ssl.SSLContext | None = None  # None: no TLS
    ping_s: float = 20.0  # between pings; a client that does not answer one for as long is gone
    watch: Watcher | None = None  # the page that shows what is done


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
        self._metrics = require_library(
            "prometheus_client", where="serve", called="prometheus-client, which writes /metrics", extra="serve"
        )
        self._registry = self._metrics.CollectorRegistry()
        self._registry.register(self)
        about = {"registry": self._registry, "buckets": (0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60)}
        self._seconds = self._metrics.Histogram("vjepa2_ac_decision_seconds", "Duration of a decision.", **about)

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
        self._served.session.counts.observe_seconds = self._seconds.observe
        if self._options.watch is not None:
            self._options.watch.begin(self._served.session, lambda: self._robot)
        self._ready.set()
        self._tell("ready")
        await stopping

    def _asked(self, connection: Any, request: Any) -> Any:
        """Answer what comes over HTTP, and refuse who may not come in; None: a robot may begin."""
        path, status, watch = request.path.partition("?")[0], http.HTTPStatus, self._options.watch
        if watch is not None and watch.page.has(path):
            return watch.page.answer(connection, request, self._options.access)
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
            return connection.respond(status.OK, self._page())
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
        """Serve a robot until it leaves, or a page that watches; one that comes before the model is loaded waits."""
        if self._options.watch is not None and self._options.watch.page.has(connection.request.path):
            await self._options.watch.show(connection)
            return
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

    def release(self) -> None:
        """Let actions move the robot again, after a page has stopped it."""
        if self._served is not None and self._served.session.stopped.is_set():
            self._served.session.stopped.clear()
            self._tell("released: actions move the robot again")

    @property
    def _counts(self) -> Counts:
        return Counts() if self._served is None else self._served.session.counts

    def _page(self) -> str:
        """Return the metrics in Prometheus' text format."""
        return str(self._metrics.generate_latest(self._registry).decode())

    def collect(self) -> Iterator[Any]:
        """Yield the metrics that are read when the page is made: Prometheus' collector."""
        families, counts = self._metrics.metrics_core, self._counts
        robots, gauge, counter = int(self._robot is not None), families.GaugeMetricFamily, families.CounterMetricFamily
        stopped = int(self._served is not None and self._served.session.stopped.is_set())
        for family, name, about, label, values in (
            (gauge, "ready", "1 once requests are answered.", "", {"": int(self._ready.is_set())}),
            (gauge, "robots", "Robots that are connected.", "", {"": robots}),
            (gauge, "stopped", "1 while a page has stopped the robot.", "", {"": stopped}),
            (counter, "requests_refused", "Requests that could not be used.", "", {"": counts.refused}),
            (counter, "requests_failed", "Requests at which the server failed.", "", {"": counts.failed}),
            (counter, "episodes", "Episodes that were begun.", "", {"": counts.episodes}),
            (counter, "alarms", "Frames that departed from what was predicted.", "", {"": counts.alarms}),
            (gauge, "surprise", "Of the last frame: its distance from the prediction.", "", {"": counts.surprise}),
            (counter, "decisions", "Decisions, by their reason.", "why", counts.decisions),
            (counter, "connections_refused", "Connections, by HTTP status.", "status", self._turned_away),
        ):
            found = family(f"vjepa2_ac_{name}", about, labels=[label] if label else [])
            for key, value in sorted(dict(values).items()):
                found.add_metric([key] if label else [], value)
            yield found


def serve(load: Callable[[], Served], options: ServerOptions, tell: Callable[[str], None]) -> bool:
    """Serve until SIGTERM or SIGINT; return whether the planning thread has ended, too. SIGUSR1 releases a stop.

    Raises:
        InputError: As `PlanningServer.run`.
    """
    server = PlanningServer(load, options, tell)
    return until_signalled(server.run, {signal.SIGUSR1: server.release})


async def _first_of(*futures: asyncio.Future[Any]) -> None:
    await asyncio.wait(futures, return_when=asyncio.FIRST_COMPLETED)


def _busy(robot: str) -> str:
    return f"busy: a robot at {robot} is being served, and one server moves one robot"


def _name(connection: Any) -> str:
    address = connection.remote_address
    return f"{address[0]}:{address[1]}" if isinstance(address, tuple) else "an unknown address"
