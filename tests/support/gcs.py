"""An emulator of Google Cloud Storage in memory, with persistent connections and failures on demand."""

from __future__ import annotations

import io
import json
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit

from gcp_storage_emulator.handlers.buckets import _make_bucket_resource
from gcp_storage_emulator.handlers.objects import _checksums, _make_object_resource
from gcp_storage_emulator.server import RequestHandler, Router
from gcp_storage_emulator.storage import Storage

_PATIENCE_S = 30.0

Failure = int | str


@dataclass(frozen=True)
class Request:
    """A received request and the size of its answer."""

    target: str  # "METHOD /address", unquoted; for an upload followed by the object's name
    object: str  # "bucket/name" of the object whose bytes were requested; "" for other requests
    sent: int  # bytes of the answer's body


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
    """The interface of tests to the storage. At the start of a test the storage is empty and has no faults.

    Attributes:
        url: Address of the storage; STORAGE_EMULATOR_HOST is set to it.
        requests: All requests, in the order of the answers.
        most_in_flight: Maximum number of simultaneous requests.
    """

    def __init__(self) -> None:
        self._storage, self._one_at_a_time = Storage(use_memory_fs=True), threading.Lock()
        self._lock = threading.Condition()
        self._faults: list[_Fault] = []
        self._in_flight = 0
        self.url = ""
        self.requests: list[Request] = []
        self.most_in_flight = 0
        self._meeting = _Meeting(0, "")

    def upload(self, source: Path, path: str) -> str:
        """Put a file, or all files of a folder, at "bucket" or "bucket/prefix"; return the gs:// URL of it."""
        files = [source] if source.is_file() else [path for path in sorted(source.rglob("*")) if path.is_file()]
        for file in files:
            self.put(f"{path}/{file.relative_to(source).as_posix()}" if source.is_dir() else path, file.read_bytes())
        return f"gs://{path}"

    def put(self, path: str, data: bytes) -> str:
        """Put bytes at "bucket/name" without a request; return the gs:// URL."""
        bucket, _, name = path.partition("/")
        about = _make_object_resource("", bucket, name, "application/octet-stream", str(len(data)))
        with self._one_at_a_time:
            if bucket not in self._storage.buckets:
                self._storage.create_bucket(bucket, _make_bucket_resource(bucket))
            self._storage.create_file(bucket, name, data, _checksums(data, about))
        return f"gs://{path}"

    def fail_next(self, failure: Failure, *, times: int = 1, match: str = "") -> None:
        """Make the next requests fail.

        Args:
            failure: An HTTP status. "reset": the connection is closed. "cut": it is closed in the middle of the body.
                "short": only half of the body is sent, with this length. "hang": no answer before the client leaves.
            times: Number of requests that fail.
            match: Regular expression that is searched in the unquoted "METHOD /address"; empty: any request. Bytes of
                objects are requested with "GET /download/storage/v1/b/BUCKET/o/NAME".
        """
        with self._lock:
            self._faults.append(_Fault(failure, times, match))

    def hold(self, number: int, match: str) -> None:
        """Delay the answers to matching requests until `number` requests are open at the same time, at most 30 s."""
        self._meeting = _Meeting(number, match, time.monotonic() + _PATIENCE_S)

    @property
    def faults_left(self) -> int:
        """Number of faults set by `fail_next` that have not occurred yet."""
        return sum(fault.times for fault in self._faults)

    def reads(self, end: str = "") -> list[Request]:
        """Return the requests for bytes of objects whose "bucket/name" ends with `end`."""
        return [request for request in self.requests if request.object.endswith(end) and request.object]

    def uploads(self) -> list[Request]:
        """Return the requests that uploaded bytes of objects."""
        return [request for request in self.requests if request.target.startswith("POST /upload/")]

    def names(self, bucket: str) -> list[str]:
        """Return the names of all objects."""
        return sorted(self._storage.objects.get(bucket, {}))

    def bytes_read(self, end: str = "") -> int:
        """Return the number of bytes that were sent for objects whose "bucket/name" ends with `end`."""
        return sum(request.sent for request in self.reads(end))

    def forget(self) -> None:
        """Delete requests, faults and delays, but not the objects."""
        with self._lock:
            self._faults.clear()
            self.requests.clear()
            self._meeting, self.most_in_flight = _Meeting(0, ""), 0

    def wipe(self) -> None:
        """Wait for open requests, which a client may have abandoned, and delete everything."""
        with self._lock:
            self._lock.wait_for(lambda: self._in_flight == 0, timeout=120)
        self.forget()
        self._storage.wipe()

    def _count(self, change: int) -> None:
        with self._lock:
            self._in_flight += change
            self.most_in_flight = max(self.most_in_flight, self._in_flight)
            self._lock.notify_all()

    def _wait_for_others(self, target: str) -> None:
        meeting = self._meeting
        if re.search(meeting.match, target):
            with self._lock:
                enough = lambda: self.most_in_flight >= meeting.number  # noqa: E731
                self._lock.wait_for(enough, timeout=max(0.0, meeting.until_s - time.monotonic()))

    def _failure_of(self, target: str) -> Failure | None:
        with self._lock:
            for fault in self._faults:
                if fault.times and re.search(fault.match, target):
                    fault.times -= 1
                    return fault.failure
        return None


class _Server(ThreadingHTTPServer):
    request_queue_size = 256

    def handle_error(self, *_: object) -> None:
        """Print nothing, because the client was killed."""


@contextmanager
def running() -> Iterator[Gcs]:
    """Run the storage on a free local port within the context."""
    gcs = Gcs()
    with _Server(("127.0.0.1", 0), partial(_Handler, gcs)) as server:
        gcs.url = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), name="gcs")
        thread.start()
        yield gcs
        server.shutdown()
        thread.join()


class _Handler(RequestHandler):
    """Answers the requests of one persistent connection."""

    protocol_version = "HTTP/1.1"

    def __init__(self, gcs: Gcs, *connection: object) -> None:
        self._gcs = gcs
        super().__init__(gcs._storage, *connection)

    def _answer(self) -> None:
        gcs, connection = self._gcs, self.rfile
        body = connection.read(int(self.headers.get("Content-Length", 0)))
        name_match = re.search(rb'"name": *"([^"]*)"', body[:1000]) if self.path.startswith("/upload/") else None
        target = f"{self.command} {unquote(self.path)}" + (f" {name_match[1].decode()}" if name_match else "")
        gcs._count(1)
        try:
            gcs._wait_for_others(target)
            failure = gcs._failure_of(target)
            if failure is None and target.startswith("DELETE /upload/"):
                failure = 499  # Google's answer to a cancelled upload, which the emulator does not implement
            if failure == "hang":
                connection.read()
            response, sent = self._result(failure, body)
            gcs.requests.append(Request(target, _object_of(self.path), sent))
        finally:
            gcs._count(-1)
        self.wfile.write(response)
        self.close_connection = failure in {"reset", "cut", "hang"}

    do_GET = do_POST = do_DELETE = do_PUT = do_PATCH = _answer  # noqa: N815 - the names that http.server calls

    def _result(self, failure: Failure | None, body: bytes) -> tuple[bytes, int]:
        """Return all bytes to send, and the number of bytes of the body."""
        if failure in {"reset", "hang"}:
            return b"", 0
        if isinstance(failure, int):
            data = json.dumps({"error": {"code": failure, "message": "made to fail by a test"}}).encode()
            head = f"HTTP/1.1 {failure} Failed\r\nContent-Type: application/json\r\nContent-Length: {len(data)}\r\n\r\n"
            return head.encode() + data, len(data)
        connection = self.rfile, self.wfile
        self.rfile, self.wfile = io.BytesIO(body), io.BytesIO()
        with self._gcs._one_at_a_time:
            Router(self).handle(self.command)
        head, _, data = self.wfile.getvalue().partition(b"\r\n\r\n")
        self.rfile, self.wfile = connection
        sent = data[: len(data) // 2] if failure in {"short", "cut"} else data
        if failure == "short":
            head = re.sub(rb"Content-Length: \d+", b"Content-Length: %d" % len(sent), head)
        return head + b"\r\n\r\n" + sent, len(sent)


def _object_of(address: str) -> str:
    parts = urlsplit(address)
    match = re.search(r"/b/([^/]+)/o/([^/?]+)$", parts.path)
    return f"{match[1]}/{unquote(match[2])}" if match and parse_qs(parts.query).get("alt") == ["media"] else ""
