"""A Google Cloud Storage for tests: the real emulator, in memory, behind a proxy that fails on demand."""

from __future__ import annotations

import asyncio
import http.client
import json
import re
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, quote, unquote, urlsplit

if TYPE_CHECKING:  # tests that need no storage run without the emulator
    from gcp_storage_emulator.server import Server

LOOPBACK = "127.0.0.1"
_PATIENCE_S = 30.0

Failure = int | str

_NOTHING = (
    b"--B\r\nContent-Type: application/json\r\n\r\n{}\r\n"
    b"--B\r\nContent-Type: application/octet-stream\r\n\r\n\r\n--B--\r\n"
)


@dataclass(frozen=True)
class Request:
    """One request that came in, and how it was answered."""

    target: str  # "METHOD /address", unquoted; of an upload with the object's name behind it
    object: str  # "bucket/name" of the object whose bytes were asked for; else ""
    sent: int  # bytes of the body


@dataclass
class _Fault:
    failure: Failure
    times: int
    match: str


@dataclass(frozen=True)
class _Meeting:
    number: int  # of requests
    match: str
    until_s: float = 0.0  # of time.monotonic


class Gcs:
    """What a test tells the storage, and asks it. A test begins with an empty one without faults.

    Attributes:
        url: Where it answers; STORAGE_EMULATOR_HOST is set to it.
        requests: All that came in, in the order of the answers.
        most_in_flight: Most requests that were open at the same time.
    """

    def __init__(self, emulator: Server, port: int) -> None:
        self._emulator, self._port, self._lock = emulator, port, threading.Condition()
        self._faults: list[_Fault] = []
        self._in_flight = 0
        self.url = ""
        self.requests: list[Request] = []
        self.most_in_flight = 0
        self._meeting = _Meeting(0, "")

    def upload(self, source: Path, place: str) -> str:
        """Put a file, or all files of a folder, at "bucket" or "bucket/prefix"; return the gs:// URL of it."""
        files = [source] if source.is_file() else [path for path in sorted(source.rglob("*")) if path.is_file()]
        for file in files:
            self.put(f"{place}/{file.relative_to(source).as_posix()}" if source.is_dir() else place, file.read_bytes())
        return f"gs://{place}"

    def put(self, place: str, data: bytes) -> str:
        """Put bytes at "bucket/name", past the proxy; return the gs:// URL."""
        bucket, _, name = place.partition("/")
        if self._post("/storage/v1/b", json.dumps({"name": bucket}).encode(), "application/json") not in {200, 409}:
            raise RuntimeError(f"no bucket {bucket}")
        address = f"/upload/storage/v1/b/{bucket}/o?name={quote(name, safe='')}&uploadType="
        if data:
            status = self._post(f"{address}media", data, "application/octet-stream")
        else:  # the emulator takes an empty object only so
            status = self._post(f"{address}multipart", _NOTHING, "multipart/related; boundary=B")
        if status != 200:
            raise RuntimeError(f"no object {place}")
        return f"gs://{place}"

    def fail_next(self, failure: Failure, *, times: int = 1, match: str = "") -> None:
        """Let the next requests fail.

        Args:
            failure: An HTTP status. "reset": the connection is cut. "cut": it is cut in the middle of the body.
                "short": half the body is sent as if it were all. "hang": no answer until the client goes.
            times: How many requests.
            match: Regular expression that is searched in the unquoted "METHOD /address"; empty: any request. Bytes of
                objects are asked for with "GET /download/storage/v1/b/BUCKET/o/NAME".
        """
        with self._lock:
            self._faults.append(_Fault(failure, times, match))

    def hold(self, number: int, match: str) -> None:
        """Answer no request of such an address before so many requests were open at the same time, or 30 s are over."""
        self._meeting = _Meeting(number, match, time.monotonic() + _PATIENCE_S)

    @property
    def faults_left(self) -> int:
        """How many of the faults asked for have not happened."""
        return sum(fault.times for fault in self._faults)

    def reads(self, end: str = "") -> list[Request]:
        """Return the requests for bytes of objects whose "bucket/name" ends so."""
        return [request for request in self.requests if request.object.endswith(end) and request.object]

    def uploads(self) -> list[Request]:
        """Return the requests that brought bytes of objects."""
        return [request for request in self.requests if request.target.startswith("POST /upload/")]

    def names(self, bucket: str) -> list[str]:
        """Return the names of all objects, asked past the proxy."""
        with closing(http.client.HTTPConnection(LOOPBACK, self._port, timeout=120)) as connection:
            connection.request("GET", f"/storage/v1/b/{bucket}/o?maxResults=1000")
            return sorted(item["name"] for item in json.loads(connection.getresponse().read()).get("items", []))

    def bytes_read(self, end: str = "") -> int:
        """Return how many bytes of such objects were sent."""
        return sum(request.sent for request in self.reads(end))

    def forget(self) -> None:
        """Forget requests, faults and what is held; the objects stay."""
        with self._lock:
            self._faults.clear()
            self.requests.clear()
            self._meeting, self.most_in_flight = _Meeting(0, ""), 0

    def wipe(self) -> None:
        """Forget everything, also what a client gave up waiting for."""
        with self._lock:
            self._lock.wait_for(lambda: self._in_flight == 0, timeout=120)
        self.forget()
        self._emulator.wipe()

    def _post(self, address: str, data: bytes, kind: str) -> int:
        with closing(http.client.HTTPConnection(LOOPBACK, self._port, timeout=120)) as connection:
            connection.request("POST", address, data, {"Content-Type": kind})
            return connection.getresponse().status

    def _count(self, change: int) -> None:
        with self._lock:
            self._in_flight += change
            self.most_in_flight = max(self.most_in_flight, self._in_flight)
            self._lock.notify_all()

    def _failure_of(self, target: str) -> Failure | None:
        with self._lock:
            for fault in self._faults:
                if fault.times and re.search(fault.match, target):
                    fault.times -= 1
                    return fault.failure
        return None


@contextmanager
def running() -> Iterator[Gcs]:
    """Start emulator and proxy on free ports of this machine; stop them in the end."""
    from gcp_storage_emulator.server import create_server

    emulator = create_server(LOOPBACK, 0, in_memory=True)
    emulator.start()
    gcs = Gcs(emulator, emulator._api._httpd.server_address[1])
    loop = asyncio.new_event_loop()
    proxy = loop.run_until_complete(asyncio.start_server(_Proxy(gcs).serve, LOOPBACK, 0, backlog=256))
    gcs.url = f"http://{LOOPBACK}:{proxy.sockets[0].getsockname()[1]}"
    thread = threading.Thread(target=loop.run_forever, name="gcs proxy")
    thread.start()
    try:
        yield gcs
    finally:
        asyncio.run_coroutine_threadsafe(_stop(proxy), loop).result(timeout=120)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()
        emulator.stop()


async def _stop(proxy: asyncio.Server) -> None:
    proxy.close()
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)


class _Proxy:
    """HTTP/1.1 with connections that stay, in front of the emulator, which answers one request at a time."""

    def __init__(self, gcs: Gcs) -> None:
        self._gcs, self._one_at_a_time = gcs, asyncio.Semaphore(1)
        self._serving = set[object]()  # the loop forgets a task whose client was killed

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the requests of one connection."""
        self._serving.add(task := asyncio.current_task())
        with suppress(ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError):
            while await self._answer(*await _read_message(reader), reader, writer):
                pass
        writer.close()
        self._serving.discard(task)

    async def _answer(
        self, head: bytes, body: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> bool:
        """Answer one request; return whether the connection stays."""
        gcs = self._gcs
        method, address, _ = head.split(b"\r\n", 1)[0].decode().split(" ")
        named = re.search(rb'"name": *"([^"]*)"', body[:1000]) if address.startswith("/upload/") else None
        target = f"{method} {unquote(address)}" + (f" {named[1].decode()}" if named else "")
        gcs._count(1)
        try:
            if re.search(gcs._meeting.match, target):
                while gcs.most_in_flight < gcs._meeting.number and time.monotonic() < gcs._meeting.until_s:
                    await asyncio.sleep(0.002)
            failure = gcs._failure_of(target)
            if failure is None and target.startswith("DELETE /upload/"):
                failure = 499  # as Google answers to whoever gives an upload up; the emulator does not know it
            if failure == "hang":
                await reader.read()
            answer, sent = await self._result(failure, head, body)
            gcs.requests.append(Request(target, _object_of(address), sent))
        finally:
            gcs._count(-1)
        writer.write(answer)
        await writer.drain()
        if failure == "reset":
            writer.transport.abort()
        return failure not in {"reset", "cut", "hang"}

    async def _result(self, failure: Failure | None, head: bytes, body: bytes) -> tuple[bytes, int]:
        """Return all bytes to send, and how many of them are body."""
        if failure in {"reset", "hang"}:
            return b"", 0
        if isinstance(failure, int):
            message = json.dumps({"error": {"code": failure, "message": "made to fail by a test"}}).encode()
            kind = {"Content-Type": "application/json"}
            return _message(f"HTTP/1.1 {failure} Failed", kind, message), len(message)
        async with self._one_at_a_time:
            status_line, headers, data = await self._ask_emulator(head, body)
        half = data[: len(data) // 2]
        if failure == "short":
            return _message(status_line, headers, half), len(half)
        answer = _message(status_line, headers, data)
        if failure == "cut":
            return answer[: len(answer) - len(data) + len(half)], len(half)
        return answer, len(data)

    async def _ask_emulator(self, head: bytes, body: bytes) -> tuple[str, dict[str, str], bytes]:
        reader, writer = await asyncio.open_connection(LOOPBACK, self._gcs._port, limit=1 << 20)
        try:
            writer.write(head + body)
            head, data = await _read_message(reader)
        finally:
            writer.close()
        headers = {name: _header(head, name) for name in ("Content-Type", "Location", "Range")}
        return head.split(b"\r\n", 1)[0].decode().replace("HTTP/1.0", "HTTP/1.1"), headers, data


async def _read_message(reader: asyncio.StreamReader) -> tuple[bytes, bytes]:
    """Return head and body of one request or answer; a request without a length has no body."""
    head = await reader.readuntil(b"\r\n\r\n")
    return head, await reader.readexactly(int(_header(head, "Content-Length") or 0))


def _message(status_line: str, headers: Mapping[str, str], data: bytes) -> bytes:
    lines = [status_line, *(f"{name}: {value}" for name, value in headers.items() if value)]
    return "\r\n".join([*lines, f"Content-Length: {len(data)}", "", ""]).encode() + data


def _header(head: bytes, name: str) -> str:
    found = re.search(rf"^{name}: *(.*?)\r$", head.decode("latin-1"), re.IGNORECASE | re.MULTILINE)
    return found[1] if found else ""


def _object_of(address: str) -> str:
    parts = urlsplit(address)
    found = re.search(r"/b/([^/]+)/o/([^/?]+)$", parts.path)
    return f"{found[1]}/{unquote(found[2])}" if found and parse_qs(parts.query).get("alt") == ["media"] else ""
