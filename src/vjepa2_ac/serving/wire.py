"""The wire format: msgpack maps with NumPy arrays, as openpi's clients write and read them.

Received messages are not trusted. Their types, lengths, depth and number of parts are checked before memory is
allocated. Arrays must have one of a few plain types, and exactly the bytes of their shape.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vjepa2_ac.errors import require_library

MOST_BYTES = 32 << 20  # size limit of a message; fits eight images of 1280 x 720 pixels
MOST_PARTS = 256  # maps, lists and arrays in a message
MOST_ENTRIES = 64  # entries of a map or list
MOST_CHARACTERS = 4096  # characters of a text
MOST_DEPTH = 6  # nesting of maps and lists
MOST_AXES = 4  # dimensions of an array

_ARRAY, _SCALAR, _DATA, _DTYPE, _SHAPE = b"__ndarray__", b"__npgeneric__", b"data", b"dtype", b"shape"
_TYPES = frozenset({"|b1", "|u1", "|i1", "<u2", "<u4", "<u8", "<i2", "<i4", "<i8", "<f2", "<f4", "<f8"})
_ITEM_BYTES = {kind: int(kind[2:]) for kind in _TYPES}


class WireError(ValueError):
    """A message that violates the protocol. The text is a sentence for the sender."""


def unpack(message: bytes) -> dict[str, Any]:
    """Decode a message into a map of texts, numbers, booleans, None, bytes, lists, maps, and writable NumPy arrays.

    Raises:
        WireError: The message is no msgpack map with text keys, or contains other types or too large values.
    """
    if len(message) > MOST_BYTES:
        raise WireError(f"a message of {len(message):,} bytes; {MOST_BYTES:,} at most")
    parts, msgpack = _Parts(), require_msgpack()
    try:
        decoded = msgpack.unpackb(
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
    if not isinstance(decoded, dict):
        raise WireError(f"a message is a map; this one is a {type(decoded).__name__}")
    _require_plain(decoded, MOST_DEPTH)
    return decoded


def pack(message: Mapping[str, Any]) -> bytes:
    """Encode a map of plain values and NumPy arrays of numbers or booleans.

    Raises:
        TypeError: A value has another type.
    """
    return bytes(require_msgpack().packb(dict(message), default=_packed))


def require_msgpack(where: str = "msgpack") -> Any:
    """Import msgpack, which only the wire format needs.

    Raises:
        UnreachableError: It is not installed.
    """
    return require_library("msgpack", where=where, called="msgpack, the format of messages", extra="serve")


class _Parts:
    """Hooks for msgpack that create the maps, lists and arrays of a message and limit their number.

    msgpack calls the hooks for the innermost maps and lists first.
    """

    def __init__(self) -> None:
        self._made = 0

    def map(self, pairs: list[tuple[Any, Any]]) -> Any:
        self._count()
        keys = [key for key, _ in pairs]
        if len(set(keys)) != len(keys):
            raise WireError("a map that has a key twice")
        entries = dict(pairs)
        if _ARRAY in entries:
            return _array(entries)
        if _SCALAR in entries:
            return _scalar(entries)
        if not all(isinstance(key, str) for key in keys):
            raise WireError("a map whose keys are not texts")
        return entries

    def list(self, items: list[Any]) -> list[Any]:
        self._count()
        return items

    def _count(self) -> None:
        self._made += 1
        if self._made > MOST_PARTS:
            raise WireError(f"more than {MOST_PARTS} maps and lists in a message")


def _array(entries: dict[Any, Any]) -> np.ndarray:
    if entries.keys() != {_ARRAY, _DATA, _DTYPE, _SHAPE} or entries[_ARRAY] is not True:
        raise WireError("an array that is not written as `data`, `dtype` and `shape`")
    dtype, shape, data = _type(entries[_DTYPE]), entries[_SHAPE], entries[_DATA]
    is_shape = isinstance(shape, list) and len(shape) <= MOST_AXES
    if not is_shape or not all(type(side) is int and 0 <= side <= MOST_BYTES for side in shape):
        raise WireError(f"the shape of an array is a list of up to {MOST_AXES} whole numbers from 0")
    if not isinstance(data, bytes) or math.prod(shape) * _ITEM_BYTES[dtype] != len(data):
        raise WireError(f"an array whose bytes are not those of its shape and its type, {dtype}")
    if dtype == "|b1":  # NumPy requires the bytes 0 and 1; any byte except 0 means true
        return np.asarray(np.frombuffer(data, dtype="|u1").reshape(shape) != 0)
    return np.frombuffer(data, dtype=dtype).reshape(shape).copy()  # frombuffer returns a read-only array


def _scalar(entries: dict[Any, Any]) -> bool | int | float:
    if entries.keys() != {_SCALAR, _DATA, _DTYPE} or entries[_SCALAR] is not True:
        raise WireError("a NumPy number that is not written as `data` and `dtype`")
    _type(entries[_DTYPE])
    value = entries[_DATA]
    if not isinstance(value, bool | int | float):
        raise WireError(f"a NumPy number that is a {type(value).__name__}")
    return value


def _type(dtype: Any) -> str:
    if not isinstance(dtype, str) or dtype not in _TYPES:
        raise WireError(f"an array of another type than {', '.join(sorted(_TYPES))}")
    return dtype


def _require_plain(value: Any, depth: int) -> None:
    """Check that a value contains only types of the protocol.

    Raises:
        WireError: It contains another type, or more than `depth` nested maps and lists.
    """
    if isinstance(value, dict | list):
        if not depth:
            raise WireError(f"maps and lists nested deeper than {MOST_DEPTH}")
        for item in value.values() if isinstance(value, dict) else value:
            _require_plain(item, depth - 1)
    elif not isinstance(value, np.ndarray | str | bytes | bool | int | float | None):
        raise WireError(f"a {type(value).__name__} in a message")


def _packed(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf":
        value = np.ascontiguousarray(value) if isinstance(value, np.ndarray) else value
        if isinstance(value, np.generic):
            return {_SCALAR: True, _DATA: value.item(), _DTYPE: value.dtype.str}
        return {_ARRAY: True, _DATA: value.tobytes(), _DTYPE: value.dtype.str, _SHAPE: value.shape}
    raise TypeError(f"{type(value).__name__} cannot be sent")
