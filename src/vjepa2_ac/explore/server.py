"""The server of the page: one websocket per page, and one thread that computes the newest request of each page."""

from __future__ import annotations

import asyncio
import contextlib
import http
import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from vjepa2_ac.errors import InputError, UserError, require_library
from vjepa2_ac.explore.views import MAX_REQUEST_BYTES, PageRequest, Views, encode_message, read_request
from vjepa2_ac.planning.planner import SearchCancelledError
from vjepa2_ac.serving.access import (
    Access,
    format_url,
    get_single_header,
    run_until_signal,
    translate_listen_errors,
    wait_for_shutdown,
)

logger = logging.getLogger(__name__)

_FILES = {
    "/": ("index.html", "text/html"),
    "/style.css": ("style.css", "text/css"),
    "/shared.js": ("shared.js", "text/javascript"),
    "/explore.js": ("explore.js", "text/javascript"),
}
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self';"
        " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_MAX_PAGES = 8  # pages that may be open at the same time


@dataclass
class _Client:
    """The state of one page: the next request, and whether it has replaced the request that is being computed."""

    pending: PageRequest | None = None
    has_request: asyncio.Event = field(default_factory=asyncio.Event)
    is_replaced: threading.Event = field(default_factory=threading.Event)


class ExploreServer:
    """Serves `Views` to browsers on this machine."""

    def __init__(self, views: Views, port: int = 0) -> None:
        """Create a server; it does not listen yet.

        Args:
            views: Computes the replies to the requests of pages.
            port: The port; 0: a free one.
        """
        self._views, self._access, self._port = views, Access("127.0.0.1"), port
        self._computing = ThreadPoolExecutor(1, "predictions")
        self._pages = 0

    async def run(self, stop: asyncio.Event, ready: Callable[[str], None]) -> None:
        """Listen until `stop` is set.

        Args:
            stop: Ends the server.
            ready: Called with the URL of the page, once it can be opened.

        Raises:
            InputError: The server cannot listen on the address.
        """
        library = require_library("websockets.asyncio.server", where="explore", called="websockets", extra="explore")
        options = {
            "process_request": self._respond,
            "max_size": MAX_REQUEST_BYTES,
            "compression": None,
            "server_header": None,
        }
        with translate_listen_errors(self._access, self._port):
            server = await library.serve(self._serve_client, self._access.host, self._port, **options)
        ready(f"{format_url(server, 'http')}/")
        try:
            await stop.wait()
        finally:
            server.close()
            await wait_for_shutdown(server.wait_closed())
            self._computing.shutdown(wait=False, cancel_futures=True)

    def _respond(self, connection: Any, request: Any) -> Any:
        """Return the HTTP response to a request; None to accept the websocket of a page.

        Only the page of this server may open a websocket: the header `Origin` must name the host of the request.
        """
        path, host, status = request.path.partition("?")[0], get_single_header(request, "Host"), http.HTTPStatus
        if self._access.find_rejection(host, None) is not None:
            return connection.respond(
                status.FORBIDDEN, "unknown host name; the page is available only on this machine\n"
            )
        if path == "/socket":
            is_same_origin = get_single_header(request, "Origin") == f"http://{host}"
            if is_same_origin:
                return None
            return connection.respond(status.FORBIDDEN, "connections from pages of other servers are not accepted\n")
        if path not in _FILES:
            return connection.respond(status.NOT_FOUND, "not found\n")
        return _make_file_response(connection, *_FILES[path])

    async def _serve_client(self, connection: Any) -> None:
        if self._pages >= _MAX_PAGES:
            await connection.close(1013, f"{_MAX_PAGES} pages are open already")
            return
        self._pages += 1
        client, closed = _Client(), require_library("websockets", where="explore", called="websockets", extra="explore")
        replies = asyncio.ensure_future(self._send_replies(connection, client))
        replies.add_done_callback(lambda _: asyncio.ensure_future(connection.close()))
        try:
            with contextlib.suppress(closed.exceptions.ConnectionClosed):
                async for message in connection:
                    if error_message := self._set_request(client, message):
                        await connection.send(error_message)
        finally:
            self._pages -= 1
            client.is_replaced.set()
            replies.cancel()
            for error in await asyncio.gather(replies, return_exceptions=True):
                if isinstance(error, Exception) and not isinstance(error, closed.exceptions.ConnectionClosed):
                    logger.error("the connection to a page was closed after an error", exc_info=error)

    def _set_request(self, client: _Client, message: str | bytes) -> bytes | None:
        """Set the next request of a page and cancel the current one; return an error message for an invalid request."""
        try:
            client.pending = read_request(message)
        except InputError as error:
            return encode_message("error", None, {"text": str(error)})
        client.is_replaced.set()
        client.has_request.set()
        return None

    async def _send_replies(self, connection: Any, client: _Client) -> None:
        """Send the first message, then the reply to the newest request whenever there is one."""
        loop = asyncio.get_running_loop()
        await connection.send(await loop.run_in_executor(self._computing, self._views.make_hello))
        while True:
            await client.has_request.wait()
            client.has_request.clear()
            request, client.is_replaced = client.pending, threading.Event()
            if request is None:
                continue

            def progress(done: int, total: int, seq: int = request.seq) -> None:
                message = encode_message("progress", seq, {"done": done, "total": total, "what": "action sequences"})
                asyncio.run_coroutine_threadsafe(connection.send(message), loop)

            reply = await loop.run_in_executor(
                self._computing, self._make_reply, request, progress, client.is_replaced.is_set
            )
            if reply is not None:
                await connection.send(reply)

    def _make_reply(
        self, request: PageRequest, progress: Callable[[int, int], None], cancelled: Callable[[], bool]
    ) -> bytes | None:
        """Return the reply to a request, which may be an error message; None if the request was cancelled."""
        try:
            return self._views.reply_to(request, progress, cancelled)
        except SearchCancelledError:
            return None
        except UserError as error:
            return encode_message("error", request.seq, {"text": str(error)})
        except Exception:
            logger.exception("an internal error occurred while a request of the page was processed")
            return encode_message("error", request.seq, {"text": "Internal error. The terminal shows the details."})


def _make_file_response(connection: Any, name: str, kind: str) -> Any:
    """Return the response that contains a file of the page."""
    response = connection.respond(http.HTTPStatus.OK, "")
    response.body = files("vjepa2_ac").joinpath("explore/page", name).read_bytes()
    del response.headers["Content-Type"], response.headers["Content-Length"]
    content_headers = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(response.body))}
    response.headers.update(content_headers | _HEADERS)
    return response


def serve_page(views: Views, port: int, ready: Callable[[str], None]) -> None:
    """Serve the page until SIGTERM or SIGINT.

    Raises:
        InputError: As for `ExploreServer.run`.
    """
    server = ExploreServer(views, port)
    run_until_signal(lambda stop: server.run(stop, ready))
