"""The wire format: msgpack maps with NumPy arrays, as openpi's clients write and read them.

Received messages are not trusted. Types, lengths, depth and number of parts are checked before memory is allocated. An
array must have one of a few plain types, and exactly the number of bytes for its shape.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vjepa2_ac.errors import require_library

MAX_MESSAGE_BYTES = 32 << 20  # size limit of a message; fits eight images of 1280 x 720 pixels
MAX_PARTS = 256  # maps, lists and arrays in a message
MAX_ENTRIES = 64  # entries of a map or list
MAX_CHARACTERS = 4096  # characters of a text
MAX_DEPTH = 6  # nesting of maps and lists
MAX_DIMENSIONS = 4  # of an array

_ARRAY, _SCALAR, _DATA, _DTYPE, _SHAPE = b"__ndarray__", b"__npgeneric__", b"data", b"dtype", b"shape"
_TYPES = frozenset({"|b1", "|u1", "|i1", "<u2", "<u4", "<u8", "<i2", "<i4", "<i8", "<f2", "<f4", "<f8"})
_ITEM_BYTES = {kind: int(kind[2:]) for kind in _TYPES}


class WireError(ValueError):
    """A message violates the protocol. The text of the error is sent to the client."""


def unpack(message: bytes) -> dict[str, Any]:
    """Decode a message into a map of texts, numbers, booleans, None, bytes, lists, maps, and writable NumPy arrays.

    Raises:
        WireError: The message is not a msgpack map with text keys, a value has another type, or a limit is exceeded.
    """
    if len(message) > MAX_MESSAGE_BYTES:
        raise WireError(f"the message has {len(message):,} bytes. Expected at most {MAX_MESSAGE_BYTES:,}")
    parts, msgpack = _Parts(), require_msgpack()
    try:
        decoded = msgpack.unpackb(
            message,
            object_pairs_hook=parts.map,
            list_hook=parts.list,
            max_array_len=MAX_ENTRIES,
            max_map_len=MAX_ENTRIES,
            max_str_len=MAX_CHARACTERS,
            max_bin_len=MAX_MESSAGE_BYTES,
            max_ext_len=0,
        )
    except WireError:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError(f"the message is not valid msgpack within the size limits ({type(error).__name__})") from None
    if not isinstance(decoded, dict):
        raise WireError(f"the message is a {type(decoded).__name__}. Expected a map")
    _require_plain(decoded, MAX_DEPTH)
    return decoded


def pack(message: Mapping[str, Any]) -> bytes:
    """Encode a map of plain values and NumPy arrays of numbers or booleans.

    Raises:
        TypeError: A value has another type.
    """
    return bytes(require_msgpack().packb(dict(message), default=_encode_array))


def require_msgpack(where: str = "msgpack") -> Any:
    """Import msgpack, which is an optional dependency.

    Raises:
        UnreachableError: msgpack is not installed.
    """
    return require_library("msgpack", where=where, called="msgpack", extra="serve")


class _Parts:
    """Hooks for msgpack that create the maps, lists and arrays of a message and limit their number.

    msgpack calls the hooks for inner maps and lists before those for outer ones.
    """

    def __init__(self) -> None:
        self._num_parts = 0

    def map(self, pairs: list[tuple[Any, Any]]) -> Any:
        self._count()
        keys = [key for key, _ in pairs]
        if len(set(keys)) != len(keys):
            raise WireError("a map contains a key twice")
        entries = dict(pairs)
        if _ARRAY in entries:
            return _decode_array(entries)
        if _SCALAR in entries:
            return _decode_scalar(entries)
        if not all(isinstance(key, str) for key in keys):
            raise WireError("a map has keys that are not strings")
        return entries

    def list(self, items: list[Any]) -> list[Any]:
        self._count()
        return items

    def _count(self) -> None:
        self._num_parts += 1
        if self._num_parts > MAX_PARTS:
            raise WireError(f"the message contains more than {MAX_PARTS} maps, lists and arrays")


def _decode_array(entries: dict[Any, Any]) -> np.ndarray:
    if entries.keys() != {_ARRAY, _DATA, _DTYPE, _SHAPE} or entries[_ARRAY] is not True:
        raise WireError("an array must have exactly the entries `data`, `dtype` and `shape`")
    dtype, shape, data = _check_dtype(entries[_DTYPE]), entries[_SHAPE], entries[_DATA]
    is_shape = isinstance(shape, list) and len(shape) <= MAX_DIMENSIONS
    if not is_shape or not all(type(side) is int and 0 <= side <= MAX_MESSAGE_BYTES for side in shape):
        raise WireError(f"the shape of an array must be a list of up to {MAX_DIMENSIONS} non-negative integers")
    if not isinstance(data, bytes) or math.prod(shape) * _ITEM_BYTES[dtype] != len(data):
        raise WireError(f"the bytes of an array do not match its shape and its type {dtype}")
    if dtype == "|b1":  # NumPy requires the bytes 0 and 1; any byte except 0 means true
        return np.asarray(np.frombuffer(data, dtype="|u1").reshape(shape) != 0)
    return np.frombuffer(data, dtype=dtype).reshape(shape).copy()  # frombuffer returns a read-only array


def _decode_scalar(entries: dict[Any, Any]) -> bool | int | float:
    if entries.keys() != {_SCALAR, _DATA, _DTYPE} or entries[_SCALAR] is not True:
        raise WireError("a NumPy scalar must have exactly the entries `data` and `dtype`")
    _check_dtype(entries[_DTYPE])
    value = entries[_DATA]
    if not isinstance(value, bool | int | float):
        raise WireError(f"a NumPy scalar contains a {type(value).__name__}. Expected a number")
    return value


def _check_dtype(dtype: Any) -> str:
    if not isinstance(dtype, str) or dtype not in _TYPES:
        raise WireError(f"an array has an unsupported type. Expected one of {', '.join(sorted(_TYPES))}")
    return dtype


def _require_plain(value: Any, depth: int) -> None:
    """Refuse a value with types that are not part of the protocol.

    Raises:
        WireError: A type is not part of the protocol, or there are more than `depth` nested maps and lists.
    """
    if isinstance(value, dict | list):
        if not depth:
            raise WireError(f"maps and lists are nested deeper than {MAX_DEPTH} levels")
        for item in value.values() if isinstance(value, dict) else value:
            _require_plain(item, depth - 1)
    elif not isinstance(value, np.ndarray | str | bytes | bool | int | float | None):
        raise WireError(f"the message contains a value of type {type(value).__name__}, which is not supported")


def _encode_array(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf":
        value = np.ascontiguousarray(value) if isinstance(value, np.ndarray) else value
        if isinstance(value, np.generic):
            return {_SCALAR: True, _DATA: value.item(), _DTYPE: value.dtype.str}
        return {_ARRAY: True, _DATA: value.tobytes(), _DTYPE: value.dtype.str, _SHAPE: value.shape}
    raise TypeError(f"values of type {type(value).__name__} cannot be sent")
