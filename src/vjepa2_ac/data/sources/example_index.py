"""Which features does a serialised tf.train.Example hold, and where, without reading what they hold?

A DROID episode is 18 MB, nearly all of it pictures; its identity and length are a few hundred bytes. Hopping over the
tags and lengths of the protobuf wire format finds them in a file, or finds one camera's pictures in a record.

Source: protobuf.dev/programming-guides/encoding (the format; no code).
"""

from __future__ import annotations

from collections.abc import Iterator

from vjepa2_ac.storage import ByteReader

_VARINT, _FIXED64, _DELIMITED, _FIXED32 = 0, 1, 2, 5
_VARINT_BYTES = 10  # at most
_HEAD_BYTES = 2 * _VARINT_BYTES


class NotAnExampleError(ValueError):
    """The bytes are not a serialised tf.train.Example."""


def locate_features(file: ByteReader, start: int, length: int) -> dict[str, tuple[int, int]]:
    """Return where each feature's serialised tf.train.Feature lies: name -> (offset in the file, length).

    What it returns has passed no CRC.

    Raises:
        NotAnExampleError: The bytes are not an Example.
    """
    found: dict[str, tuple[int, int]] = {}
    for number, features_start, features_length in _delimited_fields(file, start, start + length):
        if number != 1:
            continue
        for _, entry_start, entry_length in _delimited_fields(file, features_start, features_start + features_length):
            name, span = _read_entry(file, entry_start, entry_start + entry_length)
            found[name] = span
    return found


def _read_entry(file: ByteReader, start: int, end: int) -> tuple[str, tuple[int, int]]:
    """Read one entry of the map: field 1 is the name, field 2 the feature."""
    name, span = "", (end, 0)
    for number, offset, length in _delimited_fields(file, start, end):
        if number == 1:
            file.seek(offset)
            try:
                name = file.read(length).decode()
            except UnicodeDecodeError:
                raise NotAnExampleError(f"the name of a feature at byte {offset} is not text") from None
        elif number == 2:
            span = (offset, length)
    return name, span


def _delimited_fields(file: ByteReader, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield number, offset and length of the length-delimited fields between two offsets; skip the others."""
    position = start
    while position < end:
        file.seek(position)
        head = file.read(_HEAD_BYTES)
        tag, used = _varint(head, 0)
        kind = tag & 7
        if kind == _DELIMITED:
            length, used = _varint(head, used)
            position += used
            if position + length > end:
                raise NotAnExampleError(f"a field at byte {position} reaches beyond its message")
            yield tag >> 3, position, length
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
    """Return a number of variable length, and where it ends."""
    value = 0
    for place, byte in enumerate(data[start : start + _VARINT_BYTES]):
        value |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return value, start + place + 1
    raise NotAnExampleError("a number does not end")
