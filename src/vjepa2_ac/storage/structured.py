"""Read JSON and YAML files as mappings or typed records, and write JSON.

Untrusted files are safe to parse: neither parser executes anything, the file size is limited, and YAML aliases, which
can expand without limit, are refused. Invalid content is an InputError, a missing file a MissingFileError.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import TypeAdapter, ValidationError
from yaml.nodes import MappingNode, Node, ScalarNode

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import read_small_file, translate_read_errors

T = TypeVar("T")

MAX_BYTES = 16 << 20
_MAX_REPR_LENGTH = 120  # characters of a value in messages
_MAX_PROBLEMS = 5  # problems of one file in a message
_PLAIN_LIST = re.compile(r"\[\s+((?:(?:-?\d[\d.e+-]*|null|true|false),?\s+)+)\]")
_PYDANTIC_TERMS = {  # pydantic uses the terms of JSON; the file may be YAML
    "Value error, ": "",
    "a valid array": "a list",
    "a valid tuple": "a list",
    "an object": "a mapping of keys to values",
    "a valid dictionary": "a mapping of keys to values",
    "Tuple should": "List should",
    " after validation": "",
}


# ---- JSON ----


def parse_json_object(data: bytes | str, *, where: str, needed: str = "a JSON object", fix: str = "") -> dict[str, Any]:
    """Parse a JSON object. NaN and Infinity are accepted, because Python's `json` writes them.

    Args:
        data: The text.
        where: The file, for messages.
        needed: The expected content, for messages.
        fix: How to fix the file, for messages.

    Raises:
        InputError: The text is not JSON, or not an object.
    """
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(where=where, found=f"invalid JSON: {error}", needed=needed, fix=fix) from None
    if not isinstance(value, dict):
        raise InputError(where=where, found=f"a JSON {type(value).__name__}", needed=needed, fix=fix)
    return value


def read_json_object(
    path: str | Path, *, max_bytes: int = MAX_BYTES, needed: str = "a JSON object", fix: str = ""
) -> dict[str, Any]:
    """Read a JSON object from a local file or a URL.

    Raises:
        InputError: As for `parse_json_object`; or the file is larger than `max_bytes`.
        MissingFileError: There is no such file.
        UnreachableError: The file cannot be read now.
    """
    with translate_read_errors(path, needed=needed, fix=fix):
        data = read_small_file(path, max_bytes)
    return parse_json_object(data, where=str(path), needed=needed, fix=fix)


def format_json(value: Any) -> str:
    """Return plain values as indented JSON, with each list of numbers on one line.

    Raises:
        ValueError: A number is not finite.
    """
    text = json.dumps(value, indent=1, allow_nan=False)
    return _PLAIN_LIST.sub(lambda match: "[" + " ".join(match[1].split()) + "]", text) + "\n"


def finite_or_none(value: float) -> float | None:
    """Return a number, or None for NaN and infinity, which JSON does not have."""
    return value if math.isfinite(value) else None


def to_plain(value: Any) -> Any:
    """Convert arrays and tensors in nested values to lists, and numbers that are not finite to None."""
    if hasattr(value, "tolist"):
        return to_plain(value.tolist())
    if isinstance(value, Mapping):
        return {key: to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    return finite_or_none(value) if isinstance(value, float) else value


def utc_now() -> str:
    """Return the current time in UTC, to the second, as ISO 8601."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


# ---- records ----

_adapter: Callable[[Any], Any] = cache(TypeAdapter)


def parse_record(kind: type[T], values: Any, *, where: str, needed: str = "", fix: str = "") -> T:
    """Create a dataclass or pydantic model from JSON values, which are not converted to other types.

    Args:
        kind: The class; its annotations may have bounds (pydantic's `Field`).
        values: A mapping from field names to values; fields with a default may be missing.
        where: The file, for messages.
        needed: The expected content, for messages.
        fix: How to fix the file, for messages.

    Raises:
        InputError: A value is missing, unknown, of another type or out of bounds.
    """
    problems: list[str] = []
    if is_dataclass(kind) and isinstance(values, dict):
        problems += [f"{key}: unknown" for key in values.keys() - {field.name for field in fields(kind)}]
    try:
        record: T = _adapter(kind).validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        problems += [
            ".".join(map(str, item["loc"])) + ": " * bool(item["loc"]) + describe_validation_error(item)
            for item in error.errors()
        ]
    if problems:
        more = f"; and {len(problems) - _MAX_PROBLEMS} more" if len(problems) > _MAX_PROBLEMS else ""
        raise InputError(where=where, found="; ".join(problems[:_MAX_PROBLEMS]) + more, needed=needed, fix=fix)
    return record


def describe_validation_error(detail: Any) -> str:
    """Return pydantic's message about one value in the terms of this package, followed by the value.

    Args:
        detail: An item of `ValidationError.errors()`.
    """
    message, value = str(detail["msg"]), detail.get("input")
    if detail["type"] == "missing":
        return "missing"
    for term, replacement in _PYDANTIC_TERMS.items():
        message = message.replace(term, replacement)
    return message if isinstance(value, dict) else f"{message} (found {short_repr(value)})"


def short_repr(value: object) -> str:
    """Return the `repr` of a value, truncated if it is long."""
    text = repr(value)
    return text if len(text) <= _MAX_REPR_LENGTH else f"{text[:_MAX_REPR_LENGTH]}…"


# ---- YAML ----


def parse_yaml(text: str, *, where: str) -> Any:
    """Parse a YAML document into mappings with string keys, lists, strings, numbers, booleans and None.

    Dates, 017 and 12:30 are strings (YAML 1.1 would read the last two as the numbers 15 and 750); 1e-4 is a number.

    Raises:
        InputError: The text is not YAML, or has a duplicate key or an alias. The message contains line and column.
    """
    try:
        return yaml.load(text, _Loader)  # noqa: S506 - a SafeLoader
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        problem_where = f"{where}: line {mark.line + 1}, column {mark.column + 1}" if mark else where
        problem = getattr(error, "problem", None) or str(error)
        raise InputError(where=problem_where, found=f"invalid YAML: {problem}") from None


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader without aliases, duplicate keys and the unusual numbers of YAML 1.1."""

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        """Compose a node; refuse aliases, because a few lines of them can expand to more than fits into memory."""
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call] # PyYAML's
            raise yaml.MarkedYAMLError(problem="an alias, which is not supported; repeat the value", problem_mark=mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: MappingNode, deep: bool = False) -> dict[Any, Any]:  # noqa: ARG002 - PyYAML's
        """Return a mapping with the keys as written in the file; refuse duplicate keys."""
        mapping: dict[str, Any] = {}
        for key, value in node.value:
            if not isinstance(key, ScalarNode):
                problem = (
                    "a key that is a mapping or a list; replace template placeholders such as {{ NAME }} by values"
                )
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
            if key.value in mapping:
                raise yaml.MarkedYAMLError(problem=f"duplicate key {key.value!r}", problem_mark=key.start_mark)
            mapping[key.value] = self.construct_object(value, deep=True)
        return mapping


_NUMBERS = {  # PyYAML's patterns read 017 and 12:30 as numbers, and 1e-4 as a string
    "int": re.compile(r"[-+]?(?:0|[1-9][0-9_]*|0b[01_]+|0x[0-9a-fA-F_]+)$"),
    "float": re.compile(
        r"[-+]?(?:[0-9][0-9_]*\.[0-9_]*(?:[eE][-+]?[0-9]+)?|\.[0-9][0-9_]*(?:[eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+"
        r"|\.(?:inf|Inf|INF))$|\.(?:nan|NaN|NAN)$"
    ),
}
_OTHER_TAGS = {f"tag:yaml.org,2002:{name}" for name in (*_NUMBERS, "timestamp", "value")}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _OTHER_TAGS]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _name, _pattern in _NUMBERS.items():
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_name}", _pattern, list("-+.0123456789"))
