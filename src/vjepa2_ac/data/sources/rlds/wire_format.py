"""Positions of the features in a serialised tf.train.Example, found without reading their content.

A DROID episode is 18 MB, nearly all of it images; its identity and length are a few hundred bytes. Skipping over the
tags and lengths of the protobuf wire format finds them in a file, and finds single images in a feature. The features
of a record have no fixed order: TFDS uses that of a hash, which differs between the processes that wrote.

Source: protobuf.dev/programming-guides/encoding (the format; no code).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

Read = Callable[[int, int], bytes]  # (offset, length) -> those bytes; fewer if the file ends

BYTES_LIST, FLOAT_LIST, INT64_LIST = 1, 2, 3  # field numbers of tf.train.Feature

DELIMITED = 2  # wire type of everything with a length
_VARINT, _FIXED64, _FIXED32 = 0, 1, 5
_VARINT_BYTES = 10  # at most
_HEAD_BYTES = 2 * _VARINT_BYTES
_ENTRY_HEAD_BYTES = 160  # the headers and the name of nearly every feature
_FIRST_FIELD, _SECOND_FIELD = 0x0A, 0x12  # tags of length-delimited fields


class NotAnExampleError(ValueError):
    """The bytes are not a serialised tf.train.Example."""


class Located(NamedTuple):
    """The position of a part of a record."""

    offset: int  # in the file
    length: int


def iterate_features(read: Read, start: int, length: int) -> Iterator[tuple[str, Located]]:
    """Yield the name and position of each feature in file order, reading only as far as the caller iterates.

    A position is that of the serialised tf.train.Feature. No CRC is checked.

    Raises:
        NotAnExampleError: The bytes are not an Example.
    """
    for number, features in _delimited_fields(read, start, start + length):
        if number == 1:
            yield from _entries(read, features.offset, features.offset + features.length)


def features_behind(name: str, piece: bytes, offset: int) -> dict[str, Located]:
    """Return a feature and all following ones, from the last bytes of an Example; nothing if it is not found.

    The start of a map entry is known only from the previous entries. So the name is searched, and accepted only if the
    entries from there on fill the Example to its last byte.

    Args:
        name: The feature's.
        piece: The Example's last bytes.
        offset: Of these in the file.
    """

    def read(start: int, length: int) -> bytes:
        return piece[start - offset : start - offset + length]

    key = piece.rfind(name.encode())
    for start in range(key - 3, max(-1, key - 14), -1):
        try:
            found = dict(_entries(read, offset + start, offset + len(piece))) if start >= 0 else {}
        except NotAnExampleError:
            continue
        if next(iter(found), None) == name:
            return found
    return {}


def locate_items(read: Read, feature: Located, count: int | None = None) -> tuple[list[int], list[int]]:
    """Return offsets and lengths of the texts or images of a feature that is a list of bytes; of the first `count`.

    Raises:
        NotAnExampleError: It is not a list of bytes, or damaged.
    """
    offsets: list[int] = []
    lengths: list[int] = []
    if feature.length == 0:
        return offsets, lengths
    lists = list(_delimited_fields(read, feature.offset, feature.offset + feature.length))
    if [number for number, _ in lists] != [BYTES_LIST]:
        raise NotAnExampleError(f"the feature at byte {feature.offset} is not a list of bytes")
    position, end = lists[0][1].offset, sum(lists[0][1])
    while position < end and len(offsets) != count:
        head = read(position, 1 + _VARINT_BYTES)
        if not head or head[0] != _FIRST_FIELD:
            raise NotAnExampleError(f"byte {position} is not the start of an item")
        length, used = _varint(head, 1)
        position += used
        offsets.append(position)
        lengths.append(length)
        position += length
        if position > end:
            raise NotAnExampleError(f"the item at byte {offsets[-1]} reaches beyond its list")
    return offsets, lengths


def packed_numbers(feature: bytes, kind: int) -> memoryview | None:
    """Return the packed numbers of a serialised tf.train.Feature, or None if it is encoded differently.

    The usual encoding of every writer is one packed list.

    Args:
        feature: The complete feature.
        kind: FLOAT_LIST (little-endian float32) or INT64_LIST (varints).
    """
    try:
        outer, start = _varint(feature, 1)
        if feature[0] != kind << 3 | DELIMITED or start + outer != len(feature):
            return None
        if outer == 0:
            return memoryview(b"")
        inner, place = _varint(feature, start + 1)
        plain = feature[start] == _FIRST_FIELD and place + inner == len(feature)
        return memoryview(feature)[place:] if plain else None
    except (IndexError, NotAnExampleError):
        return None


def _entries(read: Read, start: int, end: int) -> Iterator[tuple[str, Located]]:
    position = start
    while position < end:
        entry = _plain_entry(read(position, _ENTRY_HEAD_BYTES), position, end)
        if entry is None:
            break
        name, place, position = entry
        yield name, place
    for number, field in _delimited_fields(read, position, end):
        if number == 1:
            yield _any_entry(read, field.offset, field.offset + field.length)


def _plain_entry(head: bytes, position: int, end: int) -> tuple[str, Located, int] | None:
    """Read one entry of the map in the usual encoding: the name, then the feature. None: it is encoded differently."""
    try:
        if head[0] != _FIRST_FIELD:
            return None
        length, place = _varint(head, 1)
        entry_end = position + place + length
        if entry_end > end or head[place] != _FIRST_FIELD:
            return None
        name_length, name_start = _varint(head, place + 1)
        name_end = name_start + name_length
        if head[name_end] != _SECOND_FIELD:
            return None
        feature_length, feature_start = _varint(head, name_end + 1)
        if position + feature_start + feature_length != entry_end:
            return None
        return head[name_start:name_end].decode(), Located(position + feature_start, feature_length), entry_end
    except (IndexError, NotAnExampleError, UnicodeDecodeError):
        return None


def _any_entry(read: Read, start: int, end: int) -> tuple[str, Located]:
    """Read one entry of the map: field 1 is the name, field 2 the feature, in any order."""
    name, place = "", Located(end, 0)
    for number, field in _delimited_fields(read, start, end):
        if number == 1:
            try:
                name = read(*field).decode()
            except UnicodeDecodeError:
                raise NotAnExampleError(f"the name of a feature at byte {field.offset} is not text") from None
        elif number == 2:
            place = field
    return name, place


def _delimited_fields(read: Read, start: int, end: int) -> Iterator[tuple[int, Located]]:
    """Yield number and position of the length-delimited fields between two offsets; skip the others."""
    position = start
    while position < end:
        head = read(position, _HEAD_BYTES)
        tag, used = _varint(head, 0)
        kind = tag & 7
        if kind == DELIMITED:
            length, used = _varint(head, used)
            position += used
            if position + length > end:
                raise NotAnExampleError(f"a field at byte {position} reaches beyond its message")
            yield tag >> 3, Located(position, length)
            position += length
        elif kind == _VARINT:
            position += _varint(head, used)[1]
        elif kind in {_FIXED64, _FIXED32}:
            position += used + (8 if kind == _FIXED64 else 4)
        else:
            raise NotAnExampleError(f"byte {position} is not the start of a field")
    if position != end:
        raise NotAnExampleError(f"the last field before byte {end} reaches beyond its message")


def _varint(data: bytes, start: int) -> tuple[int, int]:
    """Return a varint, and the offset of its end."""
    value = shift = 0
    for place in range(start, min(len(data), start + _VARINT_BYTES)):
        byte = data[place]
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place + 1
        shift += 7
    raise NotAnExampleError("a number does not end")
