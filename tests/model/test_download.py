"""A file arrives whole over a line that breaks, or it does not arrive."""

import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.model.download import download

CONTENT = bytes(range(256)) * 400


@dataclass
class Behaviour:
    """What the server does: how many bytes it sends before it hangs up, which answers come first, what it can."""

    content: bytes = CONTENT
    cut_after: list[int] = field(default_factory=list)
    answers: list[int] = field(default_factory=list)
    resumes: bool = True
    seen: list[int] = field(default_factory=list)  # where each request started


@pytest.fixture
def serve() -> Iterator[Callable[[Behaviour], str]]:
    servers: list[ThreadingHTTPServer] = []

    def start(behaviour: Behaviour) -> str:
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler_for(behaviour))
        servers.append(server)
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        return f"http://127.0.0.1:{server.server_port}/model.pt"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def handler_for(behaviour: Behaviour) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            match = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
            start = int(match[1]) if match and behaviour.resumes else 0
            behaviour.seen.append(start)
            if behaviour.answers:
                self.send_error(behaviour.answers.pop(0))
                return
            size = len(behaviour.content)
            if start >= size:
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{size}")
                self.end_headers()
                return
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{size - 1}/{size}")
            self.send_header("Content-Length", str(size - start))
            self.end_headers()
            end = start + behaviour.cut_after.pop(0) if behaviour.cut_after else size
            self.wfile.write(behaviour.content[start:end])

        def log_message(self, *_: object) -> None: ...

    return Handler


def test_a_file_arrives_whole_and_progress_is_told(serve, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    path = download(
        serve(Behaviour()), tmp_path / "new" / "model.pt", progress=lambda here, whole: told.append((here, whole))
    )
    assert path.read_bytes() == CONTENT
    assert told[-1] == (len(CONTENT), len(CONTENT))
    assert [entry.name for entry in path.parent.iterdir()] == ["model.pt"]


def test_a_broken_line_is_resumed_where_it_broke(serve, tmp_path: Path) -> None:
    behaviour = Behaviour(cut_after=[1000, 5000])
    path = download(serve(behaviour), tmp_path / "model.pt", wait_s=0.0)
    assert path.read_bytes() == CONTENT
    assert behaviour.seen == [0, 1000, 6000]


def test_a_part_from_an_earlier_call_is_gone_on_with(serve, tmp_path: Path) -> None:
    behaviour = Behaviour(cut_after=[1000], answers=[])
    url = serve(behaviour)
    behaviour.cut_after = [1000, 0, 0]
    with pytest.raises(InputError, match=r"no answer after 2 attempts.*1000 bytes are in .*model\.pt\.part"):
        download(url, tmp_path / "model.pt", attempts=2, wait_s=0.0)
    assert not (tmp_path / "model.pt").exists()
    assert download(url, tmp_path / "model.pt").read_bytes() == CONTENT
    assert behaviour.seen == [0, 1000, 1000, 1000]


def test_a_part_that_is_whole_already_is_kept(serve, tmp_path: Path) -> None:
    (tmp_path / "model.pt.part").write_bytes(CONTENT)
    assert download(serve(Behaviour()), tmp_path / "model.pt").read_bytes() == CONTENT


def test_a_part_longer_than_the_file_is_thrown_away(serve, tmp_path: Path) -> None:
    (tmp_path / "model.pt.part").write_bytes(CONTENT + b"more")
    assert download(serve(Behaviour()), tmp_path / "model.pt", wait_s=0.0).read_bytes() == CONTENT


def test_a_server_that_cannot_resume_sends_everything_again(serve, tmp_path: Path) -> None:
    behaviour = Behaviour(cut_after=[1000], resumes=False)
    assert download(serve(behaviour), tmp_path / "model.pt", wait_s=0.0).read_bytes() == CONTENT
    assert behaviour.seen == [0, 0]


def test_a_busy_server_is_asked_again_and_given_up_on_in_the_end(serve, tmp_path: Path) -> None:
    assert download(serve(Behaviour(answers=[503, 503])), tmp_path / "a.pt", wait_s=0.0).read_bytes() == CONTENT
    with pytest.raises(InputError, match=r"no answer after 3 attempts \(Service Unavailable\)"):
        download(serve(Behaviour(answers=[503] * 3)), tmp_path / "b.pt", attempts=3, wait_s=0.0)


def test_a_refusal_is_final(serve, tmp_path: Path) -> None:
    behaviour = Behaviour(answers=[404])
    with pytest.raises(InputError, match="the server answers 404 Not Found"):
        download(serve(behaviour), tmp_path / "model.pt", wait_s=0.0)
    assert behaviour.seen == [0]
    assert list(tmp_path.iterdir()) == []


def test_no_network_is_said_clearly(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no answer after 2 attempts \(.*refused.*\).* Check the network"):
        download("http://127.0.0.1:9/model.pt", tmp_path / "model.pt", attempts=2, wait_s=0.0)


def test_a_file_that_is_here_is_not_fetched_again(serve, tmp_path: Path) -> None:
    (tmp_path / "model.pt").write_bytes(b"mine")
    behaviour = Behaviour()
    assert download(serve(behaviour), tmp_path / "model.pt").read_bytes() == b"mine"
    assert behaviour.seen == []
