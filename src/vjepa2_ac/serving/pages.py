"""Pages: static files and a socket for browsers, on the port of a websocket server, under its rules of access."""

from __future__ import annotations

import http
import http.cookies
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, quote, unquote

from vjepa2_ac.serving.access import Access

SOCKET = "socket"  # its name below the page's own path
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self';"
        " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True)
class Page:
    """A page and its socket, below a path."""

    path: str  # begins and ends with /
    contents: Mapping[str, bytes]  # of its files, by their names; "" is the page itself

    @classmethod
    def of_package(cls, path: str, folder: str, names: Sequence[str]) -> Page:
        """Return the page of these files in a folder of this package; the first of them is the page itself."""
        contents = {name: files("vjepa2_ac").joinpath(folder, name).read_bytes() for name in names}
        return cls(path, {"": contents[names[0]], **contents})

    def has(self, path: str) -> bool:
        """Return whether a request's path is below this page's, or its own without the last /."""
        return path.startswith(self.path) or f"{path}/" == self.path

    def answer(self, connection: Any, request: Any, access: Access) -> Any:
        """Return the response to a request below this path; None: its socket may begin.

        A browser cannot send the key as a header: it comes once as `?key=`, and then in a cookie that no script reads.
        A socket is only for this server's own page: its `Origin` has to name the host of the request.

        Args:
            connection: Of the websockets library.
            request: What came over it.
            access: The rules.
        """
        path, _, query = request.path.partition("?")
        host, status = single_header(request, "Host"), http.HTTPStatus
        key = parse_qs(query).get("key")
        cookie = f"vjepa2-ac-{(host or '').rpartition(':')[2]}"  # browsers share cookies among the ports of a host
        refused = access.why_not(host, _authorization(request, cookie) if key is None else f"Bearer {key[0]}")
        if refused is not None:
            hint = f"; in a browser: {self.path}?key=KEY" if refused[0] == status.UNAUTHORIZED else ""
            return connection.respond(status(refused[0]), f"{refused[1]}{hint}\n")
        name = path[len(self.path) :]
        if key is not None or f"{path}/" == self.path:
            response = connection.respond(status.SEE_OTHER, "")
            response.headers["Location"] = self.path
            if key is not None:
                kept = f"{cookie}={quote(key[0])}; HttpOnly; SameSite=Strict; Path={self.path}"
                response.headers["Set-Cookie"] = kept
            return response
        if name == SOCKET:
            is_own = single_header(request, "Origin") in {f"http://{host}", f"https://{host}"}
            return None if is_own else connection.respond(status.FORBIDDEN, "not this server's page\n")
        if name not in self.contents:
            return connection.respond(status.NOT_FOUND, "no such page\n")
        return _file(connection, name, self.contents[name])


def _file(connection: Any, name: str, content: bytes) -> Any:
    response = connection.respond(http.HTTPStatus.OK, "")
    ending = f".{name.rpartition('.')[2]}" if name else ".html"
    own = {"Content-Type": f"{_TYPES[ending]}; charset=utf-8", "Content-Length": str(len(content)), **_HEADERS}
    for header in ("Content-Type", "Content-Length"):
        del response.headers[header]
    response.headers.update(own)
    response.body = content
    return response


def single_header(request: Any, name: str) -> str | None:
    """Return the value of a header that comes once."""
    values = request.headers.get_all(name)
    return values[0] if len(values) == 1 else None


def _authorization(request: Any, cookie: str) -> str | None:
    """Return what a request has in place of a key: its header, or the cookie as one."""
    found: http.cookies.SimpleCookie = http.cookies.SimpleCookie()
    try:
        found.load("; ".join(request.headers.get_all("Cookie")))
    except http.cookies.CookieError:
        return None
    return f"Bearer {unquote(found[cookie].value)}" if cookie in found else single_header(request, "Authorization")
