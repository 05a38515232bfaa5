"""JSON from untrusted files.

File size and nesting depth are bounded. Refused are duplicate keys, numbers out of range, NaN (where the reader does
not expect it) and text that cannot be encoded again. Invalid content is an InputError; a file that is missing or cannot
be read stays the system's OSError.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import read_bounded
from vjepa2_ac.storage.structured.nesting import require_shallow, too_deep

T = TypeVar("T")

MOST_BYTES = 16 << 20
_MOST_DIGITS = 20  # of a whole number: as many as 64 bits have
_ZERO = re.compile(r"(?<!\\)(?:\\\\)*\\u0000")
_NOT_WRITABLE = re.compile(r"\\u(?:[dD][89a-fA-F]|0000)|[\ud800-\udfff]")


def json_object(
    data: bytes | str, *, where: str, needed: str = "", fix: str = "", allow_nan: bool = False
) -> dict[str, Any]:
    """Return the keys and values of a JSON object.

    Args:
        data: The text.
        where: The file, for messages.
        needed: What it should be.
        fix: How to fix it.
        allow_nan: Accept NaN and Infinity, which are not JSON, but which Python's writer writes.

    Raises:
        InputError: It is not JSON, not within the bounds, or no object.
    """
    return _parsed(data, dict, where, needed, fix, allow_nan=allow_nan)


def json_list(data: bytes | str, *, where: str) -> list[Any]:
    """Return the values of a JSON list; arguments and errors as of `json_object`."""
    return _parsed(data, list, where, "", "", allow_nan=False)


def read_json_object(
    path: str | Path, *, most_bytes: int = MOST_BYTES, needed: str = "", fix: str = "", allow_nan: bool = False
) -> dict[str, Any]:
    """Return the keys and values of a JSON object in a file, on this machine or behind a URL.

    Raises:
        InputError: As `json_object`; or the file is larger than `most_bytes`.
        OSError: There is no such file, or it cannot be read.
    """
    data = read_bounded(path, most_bytes)
    return json_object(data, where=str(path), needed=needed, fix=fix, allow_nan=allow_nan)


def _parsed(data: bytes | str, kind: type[T], where: str, needed: str, fix: str, *, allow_nan: bool) -> T:
    needed = needed or f"a JSON {_NAMES[kind]}"
    try:
        text = data if isinstance(data, str) else data.decode(json.detect_encoding(data))
        value = json.loads(
            text.removeprefix("\ufeff"),
            object_pairs_hook=_each_once,
            parse_int=_whole_number,
            parse_float=float if allow_nan else _finite_number,
            parse_constant=float if allow_nan else _refuse_constant,
        )
        _require_writable(text, value)
    except ValueError as error:  # json's own, and UnicodeError
        raise InputError(where=where, found=f"not JSON: {error}", needed=needed, fix=fix) from None
    except RecursionError:
        raise too_deep(where, fix) from None
    if not isinstance(value, kind):
        raise InputError(where=where, found=f"a JSON {_NAMES[type(value)]}", needed=needed, fix=fix)
    require_shallow(value, where=where, fix=fix)
    return value


_NAMES = {
    dict: "object",
    list: "list",
    str: "text",
    int: "number",
    float: "number",
    bool: "truth value",
    type(None): "null",
}


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in keys if keys.count(key) > 1)!r} is given twice")
    return found


def _whole_number(digits: str) -> int:
    if len(digits) > _MOST_DIGITS:
        raise ValueError(f"a whole number of {len(digits):,} digits")
    return int(digits)


def _finite_number(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"the number {digits[:40]}, which is beyond all bounds")
    return number


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name}, which is no number")


def _require_writable(text: str, value: Any) -> None:
    """Refuse text that cannot be a file name: with a zero, or with half a surrogate pair."""
    if _NOT_WRITABLE.search(text) and _ZERO.search(json.dumps(value, ensure_ascii=False).encode().decode()):
        raise ValueError("text with a zero character")
