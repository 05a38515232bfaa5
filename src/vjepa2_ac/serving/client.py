"""A Python client of the planning server that does not need openpi."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from vjepa2_ac.errors import InputError, UnreachableError, require_library
from vjepa2_ac.serving.wire import MAX_MESSAGE_BYTES, pack, require_msgpack, unpack

_METADATA_TIMEOUT_S = 30.0  # timeout for the metadata after connecting; a server listens only after its model is loaded
_REPLY_TIMEOUT_S = 120.0  # default


class PlanningClient(ExitStack):
    """A connection to a planning server; `close` ends it.

    Example:
        >>> with PlanningClient("ws://127.0.0.1:8000") as client:
        >>>     reply = client.infer({"observation/image": image, "observation/state": state, "goal/image": goal})
    """

    def __init__(self, url: str, key: str | None = None, *, timeout_s: float | None = None) -> None:
        """Connect to a server and receive its metadata.

        Args:
            url: ws://HOST:PORT, or wss://.
            key: The server's key, if it requires one.
            timeout_s: Timeout of a reply in seconds; None: 120 s, or twice the server's deadline if that is longer.

        Raises:
            UnreachableError: There is no server, it rejects the connection, or a library of the extra `serve` is
                missing.
        """
        super().__init__()
        self.url = url
        require_msgpack(url)
        library = require_library("websockets.sync.client", where=url, called="websockets", extra="serve")
        headers = {} if key is None else {"Authorization": f"Api-Key {key}"}
        try:
            self._connection = self.enter_context(
                library.connect(
                    url, compression=None, max_size=MAX_MESSAGE_BYTES, additional_headers=headers, proxy=None
                )
            )
            self.metadata = unpack(self._connection.recv(timeout=_METADATA_TIMEOUT_S))
        except Exception as error:
            self.close()
            body = getattr(getattr(error, "response", None), "body", None)  # the server's reason for a rejection
            problem = f"{_reason(error)}: {body.decode(errors='replace').strip()}" if body else _reason(error)
            raise UnreachableError(where=url, found=problem, needed="a running server (`vjepa2-ac serve`)") from None
        deadline_s = self.metadata.get("deadline_s")
        self._timeout_s = timeout_s or max(_REPLY_TIMEOUT_S, 2 * deadline_s if isinstance(deadline_s, float) else 0.0)

    def infer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send a request and return the server's reply (docs/serving_reference.md).

        Raises:
            InputError: The server rejects the request.
            UnreachableError: The connection is lost, or there is no reply in time. After a timeout the connection is
                closed, because a late reply would be read as the reply to the next request.
        """
        try:
            self._connection.send(pack(request))
            reply = self._connection.recv(timeout=self._timeout_s)
        except TimeoutError:
            self.close()
            problem, fix = f"no reply within {self._timeout_s:g} s", "Check the server's log and connect again"
            raise UnreachableError(where=self.url, found=problem, fix=fix) from None
        except Exception as error:
            raise UnreachableError(where=self.url, found=f"the connection was lost ({_reason(error)})") from None
        if isinstance(reply, str):
            raise InputError(where=self.url, found=reply)
        return unpack(reply)


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__
