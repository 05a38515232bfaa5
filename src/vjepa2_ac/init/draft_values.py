"""Config values that `init` derived from a data set, each with a reason, and the config as YAML text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vjepa2_ac.config.loading import yaml_line
from vjepa2_ac.errors import escaped

GUESSED = "GUESSED: "
_COLUMN = 34  # text column at which comments start


@dataclass(frozen=True)
class DraftValue:
    """The value of a config key, the reason for it, and whether it is a guess."""

    value: Any
    reason: str = ""
    is_guess: bool = False


DraftValues = Mapping[str, "DraftValue | DraftValues"]


def format_yaml(header: Sequence[str], values: DraftValues) -> str:
    """Format config values as YAML, with a comment at the top and one after each value that has a reason.

    Args:
        header: Lines of the comment at the top.
        values: Values by key, nested as in the config.
    """
    lines = [f"# {escaped(line)}".rstrip() for line in header]
    for name, entry in values.items():
        if not isinstance(entry, DraftValue):
            lines.append("")
        lines += _format_lines({name: entry}, "")
    return "\n".join(lines) + "\n"


def plain_values(values: DraftValues) -> dict[str, Any]:
    """Return the values without reasons, as a nested mapping like the parsed YAML."""
    return {
        name: entry.value if isinstance(entry, DraftValue) else plain_values(entry) for name, entry in values.items()
    }


def list_guesses(values: DraftValues, prefix: str = "") -> dict[str, str]:
    """Return all guessed values with their reasons as text, by dotted key."""
    texts: dict[str, str] = {}
    for name, entry in values.items():
        if not isinstance(entry, DraftValue):
            texts |= list_guesses(entry, f"{prefix}{name}.")
        elif entry.is_guess:
            value = yaml_line(name, entry.value).removeprefix(f"{name}: ")
            texts[prefix + name] = f"{value}: {entry.reason}" if entry.reason else value
    return texts


def _format_lines(values: DraftValues, indent: str) -> Iterator[str]:
    for name, entry in values.items():
        if not isinstance(entry, DraftValue):
            yield f"{indent}{name}:"
            yield from _format_lines(entry, indent + "  ")
            continue
        line, comment = indent + yaml_line(name, entry.value), escaped(GUESSED * entry.is_guess + entry.reason)
        yield f"{line:<{_COLUMN}}  # {comment}" if comment else line
