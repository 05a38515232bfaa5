"""Knobs that are gone: configs of runs that earlier versions made still have them."""

from __future__ import annotations

from typing import Any

GONE = {
    "training.action_contrast": "a loss term that cured nothing and is gone (docs/training.md)",
}
"""What they were, by dotted key. A section with a weight of 0, or null, was off."""


def take_gone(values: dict[str, Any]) -> dict[str, Any]:
    """Remove the knobs that are gone from the values of a config; return those that were in use, by dotted key."""
    used: dict[str, Any] = {}
    for key in GONE:
        *sections, name = key.split(".")
        inside: Any = values
        for section in sections:
            inside = inside.get(section) if isinstance(inside, dict) else None
        if isinstance(inside, dict) and name in inside and _is_on(value := inside.pop(name)):
            used[key] = value
    return used


def _is_on(value: Any) -> bool:
    return bool(value.get("weight")) if isinstance(value, dict) else value is not None
