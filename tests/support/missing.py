"""What is not installed of what tests need: a bare machine does without, the project's own environment never."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.util import find_spec

import pytest

SHAPES, STORAGE = "beartype", "gcp_storage_emulator"
WITHOUT = {
    SHAPES: "shapes and types are not checked: pip install beartype",
    STORAGE: "tests of Google Cloud Storage are skipped: pip install gcp-storage-emulator",
}
_DEV = ("hypothesis", "mypy", "ruff")  # where these are, somebody installed the extra dev


def is_installed(name: str) -> bool:
    """Return whether a library can be imported, without doing so."""
    try:
        return find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def absent(environment: Mapping[str, str], installed: Callable[[str], bool] = is_installed) -> tuple[str, ...]:
    """Return which libraries of the tests themselves are not installed.

    Raises:
        pytest.UsageError: They should be: this is CI, or the extra `dev` is installed.
    """
    missing = tuple(name for name in WITHOUT if not installed(name))
    why = "CI is set" if environment.get("CI") else "the extra dev is installed" if all(map(installed, _DEV)) else ""
    if missing and why:
        raise pytest.UsageError(
            f"{', '.join(missing)}: not installed, though {why}: tests would be passed over. pip install -c"
            ' constraints.txt -e ".[sim,dev]"'
        )
    return missing
