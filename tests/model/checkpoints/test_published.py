"""Published checkpoints: names are unique, and a file appears only after a complete download."""

import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from vjepa2_ac import storage
from vjepa2_ac.cli import main
from vjepa2_ac.errors import InputError, UnreachableError
from vjepa2_ac.model import model_files
from vjepa2_ac.model.model_files import PUBLISHED, VIT_B, Published, download, find_published, find_published_file
from vjepa2_ac.storage.retries import RetryPolicy


def test_every_published_file_is_found_by_each_of_its_unique_names() -> None:
    local_names, urls = {published.file.casefold() for published in PUBLISHED}, {entry.url for entry in PUBLISHED}
    assert len(local_names) == len(urls) == len(PUBLISHED)
    for published in PUBLISHED:
        for name in (published.name, published.file, published.remote, published.remote.removesuffix(".pt")):
            assert find_published(name) is published
        assert published in {find_published_file(published.file), find_published_file(published.remote)}
    with pytest.raises(InputError, match=r"no published checkpoint with this name.*--list"):
        find_published("VJEPA2_1_VITG_384")


CONTENT = bytes(range(256)) * 400
MADE_UP = Published(
    "made-up", "elsewhere.pt", VIT_B, 384, "ema_encoder", 0.0001,
    bytes=102_400, licence="of the test",
)  # fmt: skip
two_attempts, without_waits = RetryPolicy(attempts=2, first_wait_s=0.0), RetryPolicy(first_wait_s=0.0)
PART = "made-up.pt.made-up.part"


@dataclass
class Behaviour:
    """The behaviour of a test server."""

    content: bytes = CONTENT
    cut_after: list[int] = field(default_factory=list)  # number of bytes sent to each of the first requests
    errors: list[int] = field(default_factory=list)  # status codes of the first requests
    can_resume: bool = True  # whether the server supports Range requests
    sends_size: bool = True  # whether it sends Content-Length
    starts: list[int] = field(default_factory=list)  # the first byte of each request so far


@pytest.fixture
def serve() -> Iterator[Callable[[Behaviour], str]]:
    servers: list[ThreadingHTTPServer] = []

    def start(behaviour: Behaviour) -> str:
        server = ThreadingHTTPServer(("127.0.0.1", 0), make_handler(behaviour))
        servers.append(server)
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        return f"http://127.0.0.1:{server.server_port}/model.pt"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def make_handler(behaviour: Behaviour) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            match = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
            start = int(match[1]) if match and behaviour.can_resume else 0
            behaviour.starts.append(start)
            if behaviour.errors:
                self.send_error(behaviour.errors.pop(0))
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
            if behaviour.sends_size:
                self.send_header("Content-Length", str(size - start))
            self.end_headers()
            end = start + behaviour.cut_after.pop(0) if behaviour.cut_after else size
            self.wfile.write(behaviour.content[start:end])

        def log_message(self, *_: object) -> None: ...

    return Handler


@pytest.mark.parametrize(
    ("part", "behaviour", "starts"),
    [
        (b"", Behaviour(cut_after=[1000, 5000]), [0, 1000, 6000]),
        (CONTENT, Behaviour(), None),
        (CONTENT + b"more", Behaviour(), None),
        (b"", Behaviour(cut_after=[1000], can_resume=False), [0, 0]),
        (b"", Behaviour(errors=[503, 503]), None),
    ],
    ids=["interrupted", "complete partial file", "longer partial file", "server without Range", "busy server"],
)
def test_download_completes_after_interruptions(serve, tmp_path: Path, part, behaviour, starts) -> None:
    if part:
        (tmp_path / "model.pt.part").write_bytes(part)
    assert download(serve(behaviour), tmp_path / "model.pt", policy=without_waits).read_bytes() == CONTENT
    assert starts in (None, behaviour.starts)


def test_download_resumes_the_partial_file_of_an_earlier_call(serve, tmp_path: Path) -> None:
    behaviour = Behaviour(cut_after=[1000, 0, 0])
    url = serve(behaviour)
    with pytest.raises(UnreachableError, match=r"2 attempts in .* failed.*1000 bytes are in .*model\.pt\.part"):
        download(url, tmp_path / "model.pt", policy=two_attempts)
    assert not (tmp_path / "model.pt").exists()
    assert download(url, tmp_path / "model.pt").read_bytes() == CONTENT
    assert behaviour.starts == [0, 1000, 1000, 1000]


def test_refusal_is_not_retried_and_a_missing_network_is_reported(serve, tmp_path: Path) -> None:
    behaviour = Behaviour(errors=[404])
    with pytest.raises(UnreachableError, match=r"cannot be read \(HTTP 404: .*Not Found"):
        download(serve(behaviour), tmp_path / "model.pt", policy=without_waits)
    assert behaviour.starts == [0]
    with pytest.raises(UnreachableError, match=r"2 attempts in .* failed.*refused.* Check the network"):
        download("http://127.0.0.1:9/model.pt", tmp_path / "model.pt", policy=two_attempts)
    assert list(tmp_path.iterdir()) == []


def test_download_without_content_length_raises(serve, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"without Content-Length\. Expected the size of the file"):
        download(serve(Behaviour(sends_size=False)), tmp_path / "model.pt")
    assert list(tmp_path.iterdir()) == []


def test_response_smaller_than_the_published_file_raises_and_keeps_the_partial_file(serve, tmp_path: Path) -> None:
    part = tmp_path / PART
    part.write_bytes(CONTENT[:1000])
    url = serve(Behaviour(content=b"please wait", can_resume=False))
    with pytest.raises(InputError, match=r"a file of 11 bytes\. Expected 102,400 to 102,400 bytes for made-up.*proxy"):
        download(url, tmp_path / "made-up.pt", published=MADE_UP)
    assert part.read_bytes() == CONTENT[:1000]
    assert download(serve(Behaviour()), tmp_path / "made-up.pt", published=MADE_UP).read_bytes() == CONTENT


def test_existing_file_of_a_wrong_size_raises_with_its_path(serve, tmp_path: Path) -> None:
    behaviour = Behaviour()
    path, url = tmp_path / "made-up.pt", serve(behaviour)
    path.write_bytes(b"<html>")
    with pytest.raises(InputError, match=r"made-up\.pt: a file of 6 bytes.*or set --to to another path"):
        download(url, path, published=MADE_UP)
    with pytest.raises(InputError, match=r"a folder\. Expected the path of a file"):
        download(url, tmp_path, published=MADE_UP)
    assert behaviour.starts == []


def test_disk_space_for_the_remaining_bytes_is_checked_before_the_download(
    serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(storage, "free_bytes", lambda _: 101_399)  # one byte less than the rest of the file
    part = tmp_path / PART
    part.write_bytes(CONTENT[:1000])
    with pytest.raises(InputError, match=r"GB free on its disk\. Expected 0\.0001024 GB.*--to"):
        download(serve(Behaviour()), tmp_path / "made-up.pt", published=MADE_UP)
    assert part.read_bytes() == CONTENT[:1000]


def test_download_prints_the_kind_of_file_and_its_config_key(
    serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(model_files, "PUBLISHED", (MADE_UP,))
    monkeypatch.chdir(tmp_path)
    assert main(["download", "made-up", "--url", serve(Behaviour())]) == 0
    output = capsys.readouterr().out
    assert "made-up: encoder" in output
    assert "102,400 bytes\nLicence: of the test" in output
    assert output.endswith("model.encoder.path: checkpoints/made-up.pt\n")
    assert Path("checkpoints", MADE_UP.file).read_bytes() == CONTENT


@pytest.mark.parametrize("url", ["foo.pt", "http://[", "http://a:b/", "http://a b/"])
def test_invalid_url_raises_without_retries(tmp_path: Path, url: str) -> None:
    with pytest.raises(UnreachableError, match=r"cannot be read.*Check the URL"):
        download(url, tmp_path / "model.pt")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, a disk that is always full")
def test_full_disk_raises_without_retries(serve, tmp_path: Path) -> None:
    (tmp_path / "model.pt.part").symlink_to("/dev/full")
    behaviour = Behaviour()
    with pytest.raises(InputError, match=r"model\.pt\.part: cannot be written: No space left.*Free some space"):
        download(serve(behaviour), tmp_path / "model.pt")
    assert behaviour.starts == [0]
