"""Listening: a websocket server on an address, until the process is asked to end. Of the planner, and of the page."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, TypeVar

from vjepa2_ac.errors import InputError
from vjepa2_ac.serving.access import Access

END_S = 1.5  # for connections and computations, when a server ends
_Result = TypeVar("_Result")
Handler = Callable[[Any], Coroutine[Any, Any, None]]


async def listen(library: Any, handler: Handler, access: Access, port: int, **how: Any) -> Any:
    """Return a server that listens.

    Args:
        library: `websockets.asyncio.server`.
        handler: Serves a connection.
        access: Where it listens.
        port: 0: a free one.
        how: As the library's `serve`.

    Raises:
        InputError: The address cannot be listened on.
    """
    try:
        return await library.serve(handler, access.host, port, compression=None, server_header=None, **how)
    except OSError as error:
        where, fix = f"{access.host}:{port}", "Choose another --host or --port; 0 takes a free one"
        raise InputError(where=where, found=f"cannot be listened on: {error.strerror or error}", fix=fix) from None


async def ends(*ending: Awaitable[Any]) -> bool:
    """Wait for all of them, as long as a server may take to end; return whether they are done."""
    _, late = await asyncio.wait([asyncio.ensure_future(one) for one in ending], timeout=END_S)
    return not late


def url_of(server: Any, scheme: str) -> str:
    """Return the address at which a server listens."""
    host, port = server.sockets[0].getsockname()[:2]
    return f"{scheme}://{f'[{host}]' if ':' in str(host) else host}:{port}"


def until_signalled(
    run: Callable[[asyncio.Event], Coroutine[Any, Any, _Result]], others: dict[int, Callable[[], None]] | None = None
) -> _Result:
    """Run until SIGTERM or SIGINT, which set the event that it is given; in the main thread only.

    Args:
        run: What runs.
        others: What further signals do.
    """

    async def running() -> _Result:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()
        if threading.current_thread() is threading.main_thread():
            for number, do in {signal.SIGTERM: stop.set, signal.SIGINT: stop.set, **(others or {})}.items():
                loop.add_signal_handler(number, do)
        return await run(stop)

    return asyncio.run(running())
