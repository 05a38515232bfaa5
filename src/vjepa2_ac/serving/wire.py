"""The wire format: msgpack maps with NumPy arrays in them, as openpi's clients write and read them.

Nothing that comes from the wire is trusted: types, lengths, depth and the number of parts are bounded before memory is
taken for them, and an array is one of a few plain types whose bytes are all there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vjepa2_ac.errors import require_library

MOST_BYTES = 32 << 20  # of a message: eight pictures of 1280 x 720 pixels
MOST_PARTS = 256  # maps and lists of a message, arrays included
MOST_ENTRIES = 64  # of a map or a list
MOST_CHARACTERS = 4096  # of a text
MOST_DEPTH = 6
MOST_AXES = 4  # of an array

_ARRAY, _SCALAR, _DATA, _DTYPE, _SHAPE = b"__ndarray__", b"__npgeneric__", b"data", b"dtype", b"shape"
_TYPES = frozenset({"|b1", "|u1", "|i1", "<u2", "<u4", "<u8", "<i2", "<i4", "<i8", "<f2", "<f4", "<f8"})
_ITEM_BYTES = {kind: int(kind[2:]) for kind in _TYPES}


class WireError(ValueError):
    """A message that is not one of this protocol; the text is a sentence for whoever sent it."""


def unpack(message: bytes) -> dict[str, Any]:
    """Return the map of a message: texts, numbers, booleans, None, bytes, lists, maps, and NumPy arrays of its own.

    Raises:
        WireError: It is no msgpack map with texts as keys, or something in it is of another kind or too large.
    """
    if len(message) > MOST_BYTES:
        raise WireError(f"a message of {len(message):,} bytes; {MOST_BYTES:,} at most")
    parts, msgpack = _Parts(), require_msgpack()
    try:
        found = msgpack.unpackb(
            message,
            object_pairs_hook=parts.map,
            list_hook=parts.list,
            max_array_len=MOST_ENTRIES,
            max_map_len=MOST_ENTRIES,
            max_str_len=MOST_CHARACTERS,
            max_bin_len=MOST_BYTES,
            max_ext_len=0,
        )
    except WireError:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError(f"not a msgpack message that is read here ({type(error).__name__})") from None
    if not isinstance(found, dict):
        raise WireError(f"a message is a map; this one is a {type(found).__name__}")
    _require_plain(found, MOST_DEPTH)
    return found


def pack(message: Mapping[str, Any]) -> bytes:
    """Return a message of plain values, and NumPy arrays of numbers or booleans.

    Raises:
        TypeError: Something in it is neither.
    """
    return bytes(require_msgpack().packb(dict(message), default=_packed))


def require_msgpack(where: str = "msgpack") -> Any:
    """Return msgpack, which reads and writes messages, and nothing else needs.

    Raises:
        UnreachableError: It is not installed.
    """
    return require_library("msgpack", where=where, called="msgpack, the format of messages", extra="serve")


class _Parts:
    """Makes the maps and lists of a message, and counts them: the smallest ones are made first."""

    def __init__(self) -> None:
        self._made = 0

    def map(self, pairs: list[tuple[Any, Any]]) -> Any:
        self._count()
        keys = [key for key, _ in pairs]
        if len(set(keys)) != len(keys):
            raise WireError("a map that has a key twice")
        found = dict(pairs)
        if _ARRAY in found:
            return _array(found)
        if _SCALAR in found:
            return _scalar(found)
        if not all(isinstance(key, str) for key in keys):
            raise WireError("a map whose keys are not texts")
        return found

    def list(self, items: list[Any]) -> list[Any]:
        self._count()
        return items

    def _count(self) -> None:
        self._made += 1
        if self._made > MOST_PARTS:
            raise WireError(f"more than {MOST_PARTS} maps and lists in a message")


def _array(found: dict[Any, Any]) -> np.ndarray:
    if found.keys() != {_ARRAY, _DATA, _DTYPE, _SHAPE} or found[_ARRAY] is not True:
        raise WireError("an array that is not written as `data`, `dtype` and `shape`")
    dtype, shape, data = _type(found[_DTYPE]), found[_SHAPE], found[_DATA]
    is_shape = isinstance(shape, list) and len(shape) <= MOST_AXES
    if not is_shape or not all(type(side) is int and 0 <= side <= MOST_BYTES for side in shape):
        raise WireError(f"the shape of an array is a list of up to {MOST_AXES} whole numbers from 0")
    if not isinstance(data, bytes) or math.prod(shape) * _ITEM_BYTES[dtype] != len(data):
        raise WireError(f"an array whose bytes are not those of its shape and its type, {dtype}")
    if dtype == "|b1":  # any byte but 0 is true
        return np.asarray(np.frombuffer(data, dtype="|u1").reshape(shape) != 0)
    return np.frombuffer(data, dtype=dtype).reshape(shape).copy()  # one that can be written to


def _scalar(found: dict[Any, Any]) -> bool | int | float:
    if found.keys() != {_SCALAR, _DATA, _DTYPE} or found[_SCALAR] is not True:
        raise WireError("a NumPy number that is not written as `data` and `dtype`")
    _type(found[_DTYPE])
    value = found[_DATA]
    if not isinstance(value, bool | int | float):
        raise WireError(f"a NumPy number that is a {type(value).__name__}")
    return value


def _type(found: Any) -> str:
    if not isinstance(found, str) or found not in _TYPES:
        raise WireError(f"an array of another type than {', '.join(sorted(_TYPES))}")
    return found


def _require_plain(found: Any, deep: int) -> None:
    """Refuse what no message of this protocol holds: values of other kinds, and nesting."""
    if isinstance(found, dict | list):
        if not deep:
            raise WireError(f"maps and lists nested deeper than {MOST_DEPTH}")
        for one in found.values() if isinstance(found, dict) else found:
            _require_plain(one, deep - 1)
    elif not isinstance(found, np.ndarray | str | bytes | bool | int | float | None):
        raise WireError(f"a {type(found).__name__} in a message")


def _packed(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf":
        value = np.ascontiguousarray(value) if isinstance(value, np.ndarray) else value
        if isinstance(value, np.generic):
            return {_SCALAR: True, _DATA: value.item(), _DTYPE: value.dtype.str}
        return {_ARRAY: True, _DATA: value.tobytes(), _DTYPE: value.dtype.str, _SHAPE: value.shape}
    raise TypeError(f"{type(value).__name__} cannot be sent")
