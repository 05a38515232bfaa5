"""A headless browser for tests of pages: the resulting DOM, console messages and network requests."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_TIMEOUT_S = 120  # long enough for a busy machine


@dataclass(frozen=True)
class Seen:
    """The result of opening a page."""

    dom: str
    console: tuple[str, ...]
    requests: tuple[str, ...]  # requests of the page, without those of the browser itself


def browser() -> str:
    """Return the browser's path, or skip the test."""
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(_NAMES)} is installed")
    return path


def open_page(page: Path, folder: Path, *, dark: bool = False) -> Seen:
    """Open a page from its file; nothing outside this machine can be reached."""
    log = folder / "net.json"
    process = subprocess.run(
        [
            browser(), "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
            "--host-resolver-rules=MAP * ~NOTFOUND", "--enable-logging=stderr", f"--log-net-log={log}",
            f"--user-data-dir={folder / 'profile'}", f"--blink-settings=preferredColorScheme={int(not dark)}",
            "--window-size=1600,900", "--virtual-time-budget=2000", "--dump-dom", page.as_uri(),
        ],
        capture_output=True, text=True, check=True, timeout=_TIMEOUT_S,
    )  # fmt: skip
    console = tuple(line for line in process.stderr.splitlines() if ":CONSOLE" in line)
    return Seen(process.stdout, console, _requests_of_the_page(log))


def _requests_of_the_page(log: Path) -> tuple[str, ...]:
    parameters = [event.get("params", {}) for event in json.loads(log.read_text(encoding="utf-8"))["events"]]
    requests = [event for event in parameters if re.match("https?:|ftp:|wss?:", str(event.get("url", "")))]
    return tuple(str(event["url"]) for event in requests if event.get("initiator", "not an origin") != "not an origin")
