"""Paths from the user, with the same rules for config keys, options and environment variables.

`~` is the user's home. If a path must be local, a URL is refused, because it would create a folder called `gs:`. An
invalid path raises a ValueError whose message completes a sentence that starts with the name of the config key.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

BUILTIN = "builtin:"  # prefix of models and configs in the package
NO_DATA = "none"  # data.path of a model without a config
CLOSED_LOOP_FILE = "closed_loop.json"  # in RUN/closed_loop/TASK-DOMAIN
SIMULATION_FILE = "simulation.json"  # in a data set written by `simulate record`

HUB = "hf://"

_REPOSITORY = re.compile(r"hf://[\w.-]+/[\w.-]+(@[\w./-]+)?")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")  # one slash is enough, because str(Path("gs://a")) is "gs:/a"


def is_url(path: str | Path) -> bool:
    """Return whether a path is a URL such as `gs://…`, not a local path."""
    return "://" in str(path)


def parse_folder(path: str) -> Path | str:
    """Return a local folder, possibly a `file://` URL, as a Path; return a remote folder as its URL."""
    local = path.removeprefix("file://")
    return local if is_url(local) else Path(local)


def resolve_path_or_url(path: str) -> str:
    """Resolve a path from the user that may be local or a URL: expand `~` and remove a trailing slash.

    Raises:
        ValueError: The path is empty, starts with the home of an unknown user, or is a malformed URL.
    """
    if is_url(path):
        return path.rstrip("/")
    if _SCHEME.match(path):
        raise ValueError("looks like a URL, but has only one slash after the colon")
    return resolve_local_path(path)


def resolve_local_path(path: str) -> str:
    """Resolve a path from the user that must be local: expand `~` and remove a trailing slash.

    Raises:
        ValueError: The path is empty, a URL, or starts with the home of an unknown user.
    """
    if not path.strip():
        raise ValueError("is empty")
    if is_url(path) or _SCHEME.match(path):
        raise ValueError("is a URL or looks like one, but must be a local path")
    expanded = os.path.expanduser(path)  # noqa: PTH111 - Path would remove a leading `./`
    if expanded.startswith("~"):
        raise ValueError(f"starts with the home folder of an unknown user; for a folder with this name write ./{path}")
    return expanded.rstrip("/") or "/"


def resolve_model_path(name: str) -> str:
    """Resolve the path of a model with `resolve_local_path`; a built-in name is returned unchanged.

    Raises:
        ValueError: As for `resolve_local_path`.
    """
    return name if name.startswith(BUILTIN) else resolve_local_path(name)


def resolve_encoder_path(name: str) -> str:
    """Resolve the path of an encoder with `resolve_model_path`; a Hub repository is returned unchanged.

    Raises:
        ValueError: As for `resolve_local_path`; or the Hub repository has no owner or no name.
    """
    if not name.startswith(HUB):
        return resolve_model_path(name)
    if not _REPOSITORY.fullmatch(name):
        raise ValueError(f"must have the form {HUB}owner/name or {HUB}owner/name@revision")
    return name


def to_config_value(path: Path) -> str:
    """Return the config value for a path: the path itself, with `./` before a name that starts with `~`."""
    return f"./{path}" if str(path).startswith("~") else str(path)
