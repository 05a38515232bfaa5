"""The planning server: a websocket for one robot at a time; health and counters over HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import http
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from vjepa2_ac.errors import require_library
from vjepa2_ac.serving.access import (
    Access,
    format_url,
    get_single_header,
    run_until_signal,
    translate_listen_errors,
    wait_for_shutdown,
)
from vjepa2_ac.serving.session import ClientDisconnectedError, Session
from vjepa2_ac.serving.wire import MAX_MESSAGE_BYTES, pack

_HANDSHAKE_TIMEOUT_S = 10.0
_PING_INTERVAL_S = 20.0  # interval of pings, and timeout of the pongs
_MAX_QUEUED_MESSAGES = 2  # received messages that wait for the reply to a previous message

Load = Callable[[], tuple[Session, Mapping[str, Any]]]
"""Loads the model and makes a first decision; returns the session, and the metadata that is sent on connect."""


class PlanningServer:
    """A websocket server that plans for one robot at a time."""

    def __init__(self, access: Access, port: int, print_status: Callable[[str], None]) -> None:
        """Create a server; nothing is loaded yet.

        Args:
            access: Listening address and access rules.
            port: The port; 0: a free one.
            print_status: Prints a status line.
        """
        self._access, self._port, self._print_status = access, port, print_status
        self._planning = ThreadPoolExecutor(1, "planning")
        self._robot: str | None = None  # address of the connected robot
        self._rejected: Counter[str] = Counter()  # number of rejected connections by HTTP status

    async def run(self, load: Load, stop: asyncio.Event) -> bool:
        """Reserve the port, load the model, then listen until `stop` is set.

        Args:
            load: Loads the session, in the planning thread.
            stop: Ends the server.

        Returns:
            Whether the planning thread has ended.

        Raises:
            InputError: The model cannot be loaded, or the server cannot listen on the address.
        """
        library = require_library("websockets.asyncio.server", where="serve", called="websockets", extra="serve")
        with translate_listen_errors(self._access, self._port):
            server = await library.serve(
                self._serve_robot,
                self._access.host,
                self._port,
                start_serving=False,  # only binds the address
                process_request=self._handle_http,
                max_size=MAX_MESSAGE_BYTES,
                max_queue=_MAX_QUEUED_MESSAGES,
                open_timeout=_HANDSHAKE_TIMEOUT_S,
                ping_interval=_PING_INTERVAL_S,
                ping_timeout=_PING_INTERVAL_S,
                compression=None,
                server_header=None,
            )
        loading = asyncio.wrap_future(self._planning.submit(load))
        stopping = asyncio.ensure_future(stop.wait())
        try:
            await _wait_for_first(loading, stopping)
            if not stop.is_set():
                self._session, self._metadata = loading.result()
                with translate_listen_errors(self._access, self._port):  # another program may listen on the port by now
                    await server.start_serving()
                self._print_status(f"listening on {format_url(server, 'ws')}")
                await stopping
        finally:
            server.close()  # disconnects the clients, which cancels their searches
            pending_work = asyncio.wrap_future(self._planning.submit(int))  # ends after all earlier work
            self._planning.shutdown(wait=False)
            has_ended = await wait_for_shutdown(server.wait_closed(), pending_work)
        return has_ended

    def _handle_http(self, connection: Any, request: Any) -> Any:
        """Handle an HTTP request; return None to accept a websocket connection.

        Health checks need no key. A robot is rejected while another one is connected.
        """
        path, status = request.path.partition("?")[0], http.HTTPStatus
        host, authorization = (get_single_header(request, name) for name in ("Host", "Authorization"))
        if path in {"/healthz", "/readyz"}:
            return connection.respond(status.OK, "OK\n")
        rejection = self._access.find_rejection(host, authorization)
        if rejection is None and path == "/metrics":
            return connection.respond(status.OK, self._format_metrics())
        if rejection is None and path != "/":
            return connection.respond(status.NOT_FOUND, "not found\n")
        if rejection is None and request.headers.get_all("Upgrade"):
            if request.headers.get_all("Origin"):
                rejection = status.FORBIDDEN.value, "connections from web pages are not accepted"
            elif self._robot is not None:
                rejection = status.SERVICE_UNAVAILABLE.value, _format_busy_message(self._robot)
        if rejection is None:
            return None
        self._rejected[str(rejection[0])] += 1
        return connection.respond(status(rejection[0]), f"{rejection[1]}\n")

    async def _serve_robot(self, connection: Any) -> None:
        """Serve a robot until it disconnects."""
        if self._robot is not None:  # two robots have connected at the same time
            await connection.close(1013, _format_busy_message(self._robot)[:100])
            return
        self._robot = _format_address(connection)
        disconnected = asyncio.ensure_future(connection.wait_closed())
        closed = require_library("websockets.exceptions", where="serve", called="websockets", extra="serve")
        self._print_status(f"robot connected: {self._robot}")
        try:
            await asyncio.wrap_future(self._planning.submit(self._session.reset))
            with contextlib.suppress(closed.ConnectionClosed):
                await connection.send(pack(self._metadata))
                async for message in connection:
                    if isinstance(message, str):
                        await connection.send("received a text message. Expected a binary message in msgpack")
                    elif (reply := await self._reply_to(message, disconnected)) is not None:
                        await connection.send(reply)
            self._print_status(f"robot disconnected: {self._robot}")
        finally:
            self._robot = None
            disconnected.cancel()

    async def _reply_to(self, message: bytes, disconnected: asyncio.Future[None]) -> bytes | str | None:
        """Return the reply to a message; None if the robot has disconnected, which cancels its search."""
        is_disconnected = threading.Event()
        reply = asyncio.wrap_future(
            self._planning.submit(lambda: self._session.reply_to(message, is_disconnected.is_set))
        )
        try:
            await _wait_for_first(reply, disconnected)
        finally:
            if not reply.done():
                is_disconnected.set()
        try:
            return await reply
        except ClientDisconnectedError:
            return None

    def _format_metrics(self) -> str:
        """Return the counters in Prometheus' text format."""
        counts = self._session.counts
        values = {
            "robots": int(self._robot is not None),
            "requests_refused_total": counts.rejected,
            "requests_failed_total": counts.failed,
            "episodes_total": counts.episodes,
            "alarms_total": counts.alarms,
            "surprise": counts.surprise,
            "decision_seconds_sum": counts.seconds,
            "decision_seconds_count": counts.decisions.total(),
            **{f'decisions_total{{why="{why}"}}': number for why, number in sorted(counts.decisions.items())},
            **{f'connections_refused_total{{status="{code}"}}': n for code, n in sorted(self._rejected.items())},
        }
        return "".join(f"vjepa2_ac_{name} {value}\n" for name, value in values.items())


def serve(load: Load, access: Access, port: int, print_status: Callable[[str], None]) -> bool:
    """Run a planning server until SIGTERM or SIGINT; return whether the planning thread has ended.

    Raises:
        InputError: As for `PlanningServer.run`.
    """
    return run_until_signal(partial(PlanningServer(access, port, print_status).run, load))


async def _wait_for_first(*futures: asyncio.Future[Any]) -> None:
    await asyncio.wait(futures, return_when=asyncio.FIRST_COMPLETED)


def _format_busy_message(robot: str) -> str:
    return f"busy: the robot at {robot} is connected, and a server accepts one robot at a time"


def _format_address(connection: Any) -> str:
    address = connection.remote_address
    return f"{address[0]}:{address[1]}" if isinstance(address, tuple) else "an unknown address"
