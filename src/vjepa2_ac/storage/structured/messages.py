"""Validation messages for values, without the internal names of pydantic, which checks them."""

from __future__ import annotations

import re
from typing import Any

_MOST_SHOWN = 120  # characters of a value
_NAMES = (  # pydantic uses JSON's terms; the user may have written YAML
    (re.compile(r"^Value error, "), ""),
    (re.compile(r"\ba valid array\b"), "a list"),
    (re.compile(r"\ba valid dictionary\b|\ban object\b|\bof type dict\b"), "a mapping of keys to values"),
    (re.compile(r"^Tuple\b"), "List"),
    (re.compile(r" after validation\b"), ""),
    (re.compile(r"^JSON input should be", re.IGNORECASE), "Input should be"),
)


def message_of(detail: Any) -> str:
    """Return pydantic's message for one value in this program's terms, with the value found.

    Args:
        detail: One of `ValidationError.errors()`.
    """
    message, found = str(detail["msg"]), detail.get("input")
    for inner, ours in _NAMES:
        message = inner.sub(ours, message)
    return message if isinstance(found, dict) else f"{message} (found {shown(found)})"


def shown(value: object) -> str:
    """Return a value as Python source, cut if it is long."""
    text = repr(value)
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}…"
