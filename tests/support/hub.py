"""A local Hugging Face Hub that serves folders, with the part of the API that reading data and models needs."""

from __future__ import annotations

import hashlib
import json
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from vjepa2_ac.storage import remote as filesystems

_URL_TEMPLATE = "/{repo_id}/resolve/{revision}/{filename}"
_API = re.compile(r"/api/(datasets|models)/(?P<name>[^/]+/[^/]+)(/revision/(?P<revision>[^/]+))?")
_TREE = re.compile(r"/api/(datasets|models)/(?P<name>[^/]+/[^/]+)/tree/[^/]+(/(?P<path>.*))?")
_FILE = re.compile(r"(/datasets)?/(?P<name>[^/]+/[^/]+)/resolve/[^/]+/(?P<path>.+)")
_COMMIT = "0" * 40


@dataclass
class Hub:
    """A local Hub: data sets and models by name, some of which require a token."""

    datasets: Mapping[str, Path]
    gated: Mapping[str, str] = field(default_factory=dict)  # name -> required token
    url: str = ""


@contextmanager
def serve_hub(datasets: Mapping[str, Path], gated: Mapping[str, str] | None = None) -> Iterator[Hub]:
    """Serve folders as data sets or models on a free local port, and make huggingface_hub use this port."""
    hub = Hub(datasets, gated or {})
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": hub}))
    hub.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        with pytest.MonkeyPatch.context() as patch:
            from huggingface_hub import constants, hf_file_system

            patch.setenv(
                "HF_ENDPOINT", hub.url
            )  # also set as constants, because huggingface_hub reads it only at import
            patch.setattr(constants, "ENDPOINT", hub.url)
            patch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", hub.url + _URL_TEMPLATE)
            patch.setattr(constants, "HF_TOKEN_PATH", f"{__file__}.no-token")
            patch.delenv("HF_TOKEN", raising=False)
            patch.setattr(hf_file_system, "http_backoff", partial(hf_file_system.http_backoff, max_retries=0))
            patch.setattr(filesystems, "_filesystems", {})
            yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    hub: Hub
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path)
        if match := _FILE.fullmatch(path):
            self._file(match["name"], match["path"])
        elif match := _TREE.fullmatch(path):
            self._tree(match["name"], match["path"] or "")
        elif (match := _API.fullmatch(path)) and match["name"] in self.hub.datasets:
            self._about(match["name"], match["revision"] or "main")
        else:
            self._json(401, {"error": "Invalid username or password."}, "RepoNotFound")

    do_HEAD = do_GET  # noqa: N815 - the name that http.server calls

    def _about(self, name: str, revision: str) -> None:
        if revision not in {"main", _COMMIT}:
            self._json(404, {"error": f"Invalid rev id: {revision}"}, "RevisionNotFound")
            return
        root = self.hub.datasets[name]
        files = [path.relative_to(root).as_posix() for path in sorted(root.rglob("*")) if path.is_file()]
        self._json(200, {"id": name, "sha": _COMMIT, "siblings": [{"rfilename": path} for path in files]})

    def _tree(self, name: str, path: str) -> None:
        folder = self.hub.datasets[name] / path
        if not folder.is_dir():
            self._json(404, {"error": f"{path} does not exist on main"}, "EntryNotFound")
            return
        self._json(
            200,
            [
                self._entry(name, entry)
                for entry in sorted(folder.rglob("*") if "recursive=true" in self.path.lower() else folder.iterdir())
            ],
        )

    def _entry(self, name: str, entry: Path) -> dict[str, object]:
        path = entry.relative_to(self.hub.datasets[name]).as_posix()
        if entry.is_dir():
            return {"type": "directory", "oid": "0" * 40, "size": 0, "path": path}
        data = entry.read_bytes()
        return {"type": "file", "oid": hashlib.sha256(data).hexdigest()[:40], "size": len(data), "path": path}

    def _file(self, name: str, path: str) -> None:
        token = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if name in self.hub.gated and token != self.hub.gated[name]:
            status = 403 if token else 401
            self._json(status, {"error": f"Access to dataset {name} is restricted."}, "GatedRepo")
            return
        file = self.hub.datasets[name] / path
        if not file.is_file():
            self._json(404, {"error": "Entry not found"}, "EntryNotFound")
            return
        data = file.read_bytes()
        byte_range = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        start = int(byte_range[1]) if byte_range else 0
        end = min(int(byte_range[2]) + 1, len(data)) if byte_range and byte_range[2] else len(data)
        if start >= len(data):
            self._json(416, {"error": "out of range"})
            return
        self.send_response(206 if byte_range else 200)
        self.send_header("Content-Range", f"bytes {start}-{end - 1}/{len(data)}")
        self.send_header("ETag", f'"{hashlib.sha256(data).hexdigest()}"')
        self.send_header("X-Repo-Commit", _COMMIT)
        self._body(data[start:end])

    def _json(self, status: int, content: object, code: str = "") -> None:
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        if code:
            self.send_header("X-Error-Code", code)
        self._body(json.dumps(content).encode())

    def _body(self, data: bytes) -> None:
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        """Print nothing."""
