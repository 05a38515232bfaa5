"""Nesting limit of values: shallow enough that no recursive function overflows the stack."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from vjepa2_ac.errors import InputError

MOST_DEPTH = 64


def require_shallow(value: Any, *, where: str, fix: str = "") -> None:
    """Refuse mappings and lists nested deeper than `MOST_DEPTH`.

    Raises:
        InputError: They are.
    """
    level = [value]
    for _ in range(MOST_DEPTH):
        level = [inner for outer in level for inner in _inside(outer)]
        if not level:
            return
    raise too_deep(where, fix)


def too_deep(where: str, fix: str = "") -> InputError:
    """Return the error of values that are nested too deep."""
    needed = f"at most {MOST_DEPTH} mappings and lists within one another"
    return InputError(where=where, found="values that lie too deep within one another", needed=needed, fix=fix)


def _inside(value: Any) -> Iterable[Any]:
    """Return the mappings and lists in a value."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [inner for inner in inside if isinstance(inner, dict | list)]
