"""Config keys that 0.1 had: configs of older runs still load, and a config of a user gets one plain error."""

from __future__ import annotations

import logging
from typing import Any, NamedTuple

logger = logging.getLogger(__name__)


class RemovedKey(NamedTuple):
    """What replaces a removed config key."""

    always: str
    """The behaviour that every run has now, in words: it ends the sentence "it is always ..."."""
    values: tuple[Any, ...]
    """The plain values of the config of an older run that had the same meaning; a section is a dict."""


REMOVED: dict[str, RemovedKey] = {
    # "training.betas": RemovedKey("(0.9, 0.999)", ([0.9, 0.999],)),
}
"""RemovedKey keys and sections, by their dotted key. A row for a key of `data` also holds below `replay`."""


def why_removed(key: str) -> str | None:
    """Return the explanation for a removed key; None if the key was never removed."""
    removed = REMOVED.get(key.removeprefix("replay."))
    return removed and f"removed in 0.2; it is always {removed.always} now. Delete the key"


def drop_removed_keys(values: dict[str, Any], where: str) -> None:
    """Delete removed keys from the config of an older run, in place.

    A value whose meaning is not today's is reported as a warning.

    Args:
        values: The plain values of the config.
        where: The file, for the warning.
    """
    for key, removed in REMOVED.items():
        for path in (key, f"replay.{key}") if key.startswith("data.") else (key,):
            *sections, name = path.split(".")
            section: Any = values
            for part in sections:
                section = section.get(part) if isinstance(section, dict) else None
            if not isinstance(section, dict) or name not in section:
                continue
            if (value := section.pop(name)) not in removed.values:
                logger.warning("%s: %s was %s; this version always uses %s", where, path, value, removed.always)
