"""Access to the page and its socket; the newest request of a page gets a reply."""

import http.client
import json
from typing import Any
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from vjepa2_ac.explore.views import Views
from windows import header, serving


def get(url: str, path: str, **headers: str) -> http.client.HTTPResponse:
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=60)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    response.body = response.read()  # type: ignore[attr-defined]
    connection.close()
    return response


def open_socket(url: str, origin: str | None = None, **headers: str) -> Any:
    return connect(
        url.replace("http", "ws") + "socket", origin=url.rstrip("/") if origin is None else origin or None,  # type: ignore[arg-type]
        additional_headers=headers, max_size=None,
    )  # fmt: skip


def test_page_is_served_with_a_content_security_policy(recorded: Views) -> None:
    with serving(recorded) as url:
        response = get(url, "/")
        assert response.status == 200
        assert response.getheader("Content-Type") == "text/html; charset=utf-8"
        assert "default-src 'none'" in (response.getheader("Content-Security-Policy") or "")
        assert get(url, "/explore.js").getheader("Content-Type") == "text/javascript; charset=utf-8"
        for path in ("/../server.py", "/%2e%2e/server.py", "//etc/passwd", "/socket.html", "/watch.html"):
            assert get(url, path).status == 404


@pytest.mark.parametrize("origin", ["http://other.example", "null", "", "http://127.0.0.1:1", "http://["])
def test_socket_rejects_other_origins(recorded: Views, origin: str) -> None:
    with serving(recorded) as url, pytest.raises(InvalidStatus) as rejection:
        open_socket(url, origin)
    assert rejection.value.response.status_code == 403


def test_unknown_host_name_gets_no_page(recorded: Views) -> None:
    with serving(recorded) as url:
        assert get(url, "/", Host="rebound.example").status == 403
        with pytest.raises(InvalidStatus):
            open_socket(url, "http://rebound.example", Host="rebound.example")


def test_newest_request_gets_a_reply_and_cancels_a_search(recorded: Views) -> None:
    goal = {"episode": 0, "step": 6}
    with serving(recorded) as url, open_socket(url) as page:
        page.recv()
        page.send(json.dumps({"seq": 1, "kind": "plan", "goal": goal, "model": "base", "steps": 8}))
        for seq in range(2, 30):
            page.send(json.dumps({"seq": seq, "kind": "predict", "goal": goal}))
        replies = []
        while not replies or replies[-1]["seq"] != 29:
            replies.append(header(page.recv()))
        predicted = [reply["seq"] for reply in replies if reply["kind"] == "predict"]
        assert predicted == sorted(predicted)


def test_invalid_request_gets_an_error_and_the_next_one_gets_a_reply(recorded: Views) -> None:
    with serving(recorded) as url, open_socket(url) as page:
        page.recv()
        for invalid in ("{}", b"\x00", "[" * 1000, json.dumps({"seq": 1, "kind": "predict", "episode": 999})):
            page.send(invalid)
            assert header(page.recv())["kind"] == "error"
        page.send(json.dumps({"seq": 2, "kind": "predict"}))
        assert header(page.recv())["seq"] == 2


def test_internal_error_is_logged_and_the_next_request_gets_a_reply(
    recorded: Views, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(Views, "_make_episode_reply", lambda *_: 1 / 0)
    with serving(recorded) as url, open_socket(url) as page:
        page.recv()
        page.send(json.dumps({"seq": 1, "kind": "episode"}))
        assert "Internal error" in header(page.recv())["text"]
        page.send(json.dumps({"seq": 2, "kind": "predict"}))
        assert header(page.recv())["kind"] == "predict"
    assert "ZeroDivisionError" in caplog.text
