"""Run the server of explore in a thread of the test, and open its page in a real browser."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from browser import browser
from served import run_in_thread
from vjepa2_ac.explore.server import ExploreServer
from vjepa2_ac.explore.views import Views


def header(message: Any) -> dict[str, Any]:
    """Return the header of a message from the server."""
    content: dict[str, Any] = json.loads(message[4 : 4 + int.from_bytes(message[:4], "big")])
    return content


@contextmanager
def serving(views: Views, port: int = 0) -> Iterator[str]:
    """Run the server of the page during the `with` block; yield the URL of the page."""
    with run_in_thread(ExploreServer(views, port).run, "http") as lines:
        yield lines[0]


@contextmanager
def chromium() -> Iterator[Any]:
    """Yield a headless browser; skip the test if there is none."""
    import pytest

    path, api = browser(), pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        try:
            yield started
        finally:
            started.close()


NewPage = Callable[..., Any]


def open_watched_page(context: Any) -> tuple[Any, list[str]]:
    """Return a page of a browser context, and a list that collects its errors and its requests to other hosts."""
    page, problems = context.new_page(), []
    page.on("pageerror", lambda error: problems.append(f"error: {error}"))
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    page.on("request", lambda request: None if _is_own(request.url) else problems.append(f"request: {request.url}"))
    page.on("dialog", lambda dialog: (problems.append(f"dialog: {dialog.message}"), dialog.dismiss()))
    page.set_default_timeout(60_000)  # on a busy machine
    return page, problems


def _is_own(url: str) -> bool:
    return url.startswith(("http://127.0.0.1:", "ws://127.0.0.1:", "data:", "blob:", "file:"))
