"""Conversion of plain values from a file to a record: a dataclass whose annotations declare the allowed types."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import cache
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured.messages import message_of

T = TypeVar("T")

_MOST_PROBLEMS = 5  # shown of one file
_adapter: Callable[[Any], Any] = cache(TypeAdapter)


def record_of(kind: type[T], values: Mapping[str, Any], *, where: str, needed: str = "", fix: str = "") -> T:
    """Return a dataclass of values from JSON: no value is converted to another type.

    Args:
        kind: The dataclass; its annotations may have pydantic's bounds.
        values: Of its fields; those with a default may be missing.
        where: The file, for messages.
        needed: What it should be.
        fix: How to fix it.

    Raises:
        InputError: A value is missing, unknown, of another type or beyond its bounds.
    """
    known = {field.name for field in fields(kind)}  # type: ignore[arg-type] # that is what `kind` is
    problems = [f"{key}: unknown" for key in values if key not in known]
    try:
        record: T = _adapter(kind).validate_json(json.dumps(dict(values)), strict=True)
    except ValidationError as error:
        problems += [f"{'.'.join(map(str, detail['loc']))}: {_problem_of(detail)}" for detail in error.errors()]
    if problems:
        more = f"; and {len(problems) - _MOST_PROBLEMS} more" if len(problems) > _MOST_PROBLEMS else ""
        raise InputError(where=where, found="; ".join(problems[:_MOST_PROBLEMS]) + more, needed=needed, fix=fix)
    return record


def _problem_of(detail: Any) -> str:
    return "missing" if detail["type"] == "missing" else message_of(detail)
