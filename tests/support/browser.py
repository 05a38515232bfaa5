"""A real browser, headless, for tests of pages: what it makes of a page, complains of and asks the network for."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_PATIENCE_S = 120  # on a busy machine


@dataclass(frozen=True)
class Seen:
    """What came of opening a page."""

    dom: str
    console: tuple[str, ...]
    requests: tuple[str, ...]  # of the page, not the browser's own


def browser() -> str:
    """Return the browser's path, or skip the test."""
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip(f"no browser here: none of {', '.join(_NAMES)} is installed")
    return found


def open_page(page: Path, folder: Path, *, dark: bool = False) -> Seen:
    """Open a page from its file; nothing outside this machine can be reached."""
    log = folder / "net.json"
    done = subprocess.run(
        [
            browser(), "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
            "--host-resolver-rules=MAP * ~NOTFOUND", "--enable-logging=stderr", f"--log-net-log={log}",
            f"--user-data-dir={folder / 'profile'}", f"--blink-settings=preferredColorScheme={int(not dark)}",
            "--window-size=1600,900", "--virtual-time-budget=2000", "--dump-dom", page.as_uri(),
        ],
        capture_output=True, text=True, check=True, timeout=_PATIENCE_S,
    )  # fmt: skip
    console = tuple(line for line in done.stderr.splitlines() if ":CONSOLE" in line)
    return Seen(done.stdout, console, _requests_of_the_page(log))


def _requests_of_the_page(log: Path) -> tuple[str, ...]:
    parameters = [event.get("params", {}) for event in json.loads(log.read_text(encoding="utf-8"))["events"]]
    asked = [each for each in parameters if re.match("https?:|ftp:|wss?:", str(each.get("url", "")))]
    return tuple(str(each["url"]) for each in asked if each.get("initiator", "not an origin") != "not an origin")
