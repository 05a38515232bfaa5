"""Resolution of paths given by the user: the same rules for config knobs, options and environment variables.

`~` is the user's home. Where only a local folder is allowed, a URL is refused: taken as a path it would create a
folder called `gs:`. An invalid path raises a ValueError, whose message continues after the name of the knob.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

BUILTIN = "builtin:"  # models and configs that come with the package
NO_DATA = "none"  # data.path of a model without a config
CLOSED_LOOP_FILE = "closed_loop.json"  # in RUN/closed_loop/TASK-DOMAIN
SIMULATION_FILE = "simulation.json"  # in a data set that `simulate record` made

HUB = "hf://"

_REPOSITORY = re.compile(r"hf://[\w.-]+/[\w.-]+(@[\w./-]+)?")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")  # with one slash, too: a Path turns a URL into that


def is_url(path: str | Path) -> bool:
    """Return whether a path names a file behind fsspec (`gs://…`) rather than one on this machine."""
    return "://" in str(path)


def folder_at(place: str) -> Path | str:
    """Return a folder of this machine as a path, also one at `file://`; any other as its URL."""
    local = place.removeprefix("file://")
    return local if is_url(local) else Path(local)


def anywhere(path: str) -> str:
    """Return a local path, with `~` expanded, or a URL; without a trailing slash.

    Raises:
        ValueError: It is empty, of an unknown user's home, no path, or neither a URL nor a path.
    """
    if is_url(path):
        return path.rstrip("/")
    if _SCHEME.match(path):
        raise ValueError("looks like a URL, which has two slashes behind the colon")
    return on_this_machine(path)


def on_this_machine(path: str) -> str:
    """Return a local path, with `~` expanded; without a trailing slash.

    Raises:
        ValueError: It is a URL, empty, of an unknown user's home, or no path.
    """
    if not path.strip():
        raise ValueError("is empty")
    if is_url(path) or _SCHEME.match(path):
        raise ValueError("is a URL (or looks like one), and only a path of this machine will do")
    expanded = os.path.expanduser(path)  # noqa: PTH111 - a Path would take a `./` away
    if expanded.startswith("~"):
        raise ValueError(f"names the home of a user who is not here; for a folder of that name write ./{path}")
    return expanded.rstrip("/") or "/"


def of_a_model(name: str) -> str:
    """Return the name of a model: unchanged for one of the package, any other as `on_this_machine` does.

    Raises:
        ValueError: As `on_this_machine`.
    """
    return name if name.startswith(BUILTIN) else on_this_machine(name)


def of_an_encoder(name: str) -> str:
    """Return the name of an encoder: a repository of the Hub unchanged, any other as `of_a_model` does.

    Raises:
        ValueError: As `on_this_machine`; or a repository without an owner and a name.
    """
    if not name.startswith(HUB):
        return of_a_model(name)
    if not _REPOSITORY.fullmatch(name):
        raise ValueError(f"needs {HUB}owner/name, and @revision if it is not the newest")
    return name


def literal(path: Path) -> str:
    """Return a path that means the same when it is read as a knob: a folder may be called `~`."""
    return f"./{path}" if str(path).startswith("~") else str(path)
