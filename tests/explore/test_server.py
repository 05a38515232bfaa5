"""Who may open the page and its socket, and that the newest request of a page wins."""

import http.client
import json
from typing import Any
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from vjepa2_ac.explore.views import Views
from windows import header, serving


def got(url: str, path: str, **headers: str) -> http.client.HTTPResponse:
    place = urlsplit(url)
    connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=60)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    response.body = response.read()  # type: ignore[attr-defined]
    connection.close()
    return response


def socket(url: str, origin: str | None = None, **headers: str) -> Any:
    return connect(
        url.replace("http", "ws") + "socket", origin=url.rstrip("/") if origin is None else origin or None,  # type: ignore[arg-type]
        additional_headers=headers, max_size=None,
    )  # fmt: skip


def test_the_page_is_there_with_rules_for_the_browser(recorded: Views) -> None:
    with serving(recorded) as url:
        page = got(url, "/")
        assert page.status == 200
        assert page.getheader("Content-Type") == "text/html; charset=utf-8"
        assert "default-src 'none'" in (page.getheader("Content-Security-Policy") or "")
        assert got(url, "/explore.js").getheader("Content-Type") == "text/javascript; charset=utf-8"
        for path in ("/../server.py", "/%2e%2e/server.py", "//etc/passwd", "/socket.html", "/watch.html"):
            assert got(url, path).status == 404


@pytest.mark.parametrize("origin", ["http://elsewhere.example", "null", "", "http://127.0.0.1:1", "http://["])
def test_a_page_of_somebody_else_gets_no_socket(recorded: Views, origin: str) -> None:
    with serving(recorded) as url, pytest.raises(InvalidStatus) as refused:
        socket(url, origin)
    assert refused.value.response.status_code == 403


def test_a_name_that_is_not_this_servers_gets_no_page(recorded: Views) -> None:
    with serving(recorded) as url:
        assert got(url, "/", Host="rebound.example").status == 403
        with pytest.raises(InvalidStatus):
            socket(url, "http://rebound.example", Host="rebound.example")


def test_the_newest_request_wins_and_a_search_ends_for_it(recorded: Views) -> None:
    goal = {"episode": 0, "step": 6}
    with serving(recorded) as url, socket(url) as page:
        page.recv()
        page.send(json.dumps({"seq": 1, "kind": "plan", "goal": goal, "teller": "base", "steps": 8}))
        for seq in range(2, 30):
            page.send(json.dumps({"seq": seq, "kind": "look", "goal": goal}))
        answers = []
        while not answers or answers[-1]["seq"] != 29:
            answers.append(header(page.recv()))
        looked = [one["seq"] for one in answers if one["kind"] == "look"]
        assert looked == sorted(looked)


def test_what_is_no_request_is_told_and_the_page_goes_on(recorded: Views) -> None:
    with serving(recorded) as url, socket(url) as page:
        page.recv()
        for wrong in ("{}", b"\x00", "[" * 1000, json.dumps({"seq": 1, "kind": "look", "episode": 999})):
            page.send(wrong)
            assert header(page.recv())["kind"] == "error"
        page.send(json.dumps({"seq": 2, "kind": "look"}))
        assert header(page.recv())["seq"] == 2


def test_a_failure_is_logged_and_the_page_goes_on(
    recorded: Views, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(Views, "_episode", lambda *_: 1 / 0)
    with serving(recorded) as url, socket(url) as page:
        page.recv()
        page.send(json.dumps({"seq": 1, "kind": "episode"}))
        assert "terminal" in header(page.recv())["text"]
        page.send(json.dumps({"seq": 2, "kind": "look"}))
        assert header(page.recv())["kind"] == "look"
    assert "ZeroDivisionError" in caplog.text
