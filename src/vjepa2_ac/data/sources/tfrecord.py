"""TFRecord files of tf.train.Examples, read and written without TensorFlow.

A file is a sequence of records: u64 little-endian length, masked CRC-32C of the length, data, masked CRC-32C of the
data. The data of each record is one tf.train.Example: a map from feature names to lists of bytes, floats or integers.

A DROID episode has 18 MB, nearly all of it images. The identity and the length are a few hundred bytes. Features and
single images are found by reading tags and lengths and skipping the content. The features of a record have no fixed
order: TFDS uses the order of a hash, which differs between the processes that wrote the files. Apart from this order
all protobuf writers produce the same bytes. Only this form is supported: in an entry the name precedes the feature, and
numbers are one packed list.

Source: tensorflow/tensorflow, tensorflow/core/lib/io/record_writer.h and core/example/{example,feature}.proto, and
protobuf.dev/programming-guides/encoding (the formats; no code).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO, Literal

import google_crc32c
import numpy as np

from vjepa2_ac.errors import InputError

ReadBytes = Callable[[int, int], bytes]  # (offset, length) -> bytes of a file; fewer if the file ends
ByteRange = tuple[int, int]  # offset and length of a part of a file
Kind = Literal["bytes_list", "float_list", "int64_list"]

HEADER_BYTES = 12  # of a record
_FOOTER_BYTES = 4
_PIECE_BYTES = 1 << 18  # small enough to remain in the processor's cache between reading and checking
_MASK_DELTA = 0xA282EAD8

_KINDS: tuple[Kind, ...] = ("bytes_list", "float_list", "int64_list")  # fields 1, 2, 3 of tf.train.Feature
_FIRST, _SECOND, _THIRD = 0x0A, 0x12, 0x1A  # tags of length-delimited fields 1, 2 and 3
_VARINT_BYTES = 10  # longest varint
_HEAD_BYTES = 1 + _VARINT_BYTES  # tag and length of a field
_ENTRY_HEAD_BYTES = 400  # bytes that are read at the start of an entry, for the headers and the name of the feature


@dataclass(frozen=True)
class RecordSpan:
    """The position of one record in its file."""

    path: str
    number: int
    offset: int  # offset of the header in the file
    length: int  # length of the data

    @property
    def data_offset(self) -> int:
        """Offset of the data."""
        return self.offset + HEADER_BYTES

    @property
    def end(self) -> int:
        """Offset of the byte after the record."""
        return self.data_offset + self.length + _FOOTER_BYTES

    def __str__(self) -> str:
        return f"{self.path}: record {self.number} at byte {self.offset}"


def parse_header(header: bytes, path: str, number: int, offset: int, size: int) -> RecordSpan:
    """Parse the header of a record and return the record's position.

    Args:
        header: At least the first 12 bytes of the record, if the file has them.
        path: The file, for messages.
        number: Number of the record in the file.
        offset: Offset of the record in the file.
        size: Size of the file in bytes.

    Raises:
        InputError: The CRC of the length does not match, or the file ends within the record.
    """
    where = f"{path}: record {number} at byte {offset}"
    if len(header) < HEADER_BYTES:
        raise _truncated_error(where, size, offset + HEADER_BYTES)
    length, crc = struct.unpack_from("<QI", header)
    if crc != _masked_crc(header[:8]):
        problem = "the CRC of the record length does not match, so the file is damaged or not a TFRecord file"
        raise InputError(where=where, found=problem, needed="a TFRecord file as written by TFDS")
    span = RecordSpan(path=path, number=number, offset=offset, length=length)
    if span.end > size:
        raise _truncated_error(where, size, span.end)
    return span


def verify_crc(read: ReadBytes, span: RecordSpan) -> None:
    """Check the CRC of a record's data, read in pieces.

    Raises:
        InputError: The file ends within the record, or its CRC does not match.
    """
    crc, position, end = 0, span.data_offset, span.end - _FOOTER_BYTES
    while position < end:
        piece = read(position, min(_PIECE_BYTES, end - position))
        if not piece:
            raise _truncated_error(str(span), position, span.end)
        crc = google_crc32c.extend(crc, piece)
        position += len(piece)
    footer = read(end, _FOOTER_BYTES)
    if len(footer) < _FOOTER_BYTES:
        raise _truncated_error(str(span), end + len(footer), span.end)
    if _mask(crc) != struct.unpack("<I", footer)[0]:
        problem = "the CRC of the data does not match, so the file is damaged"
        raise InputError(where=str(span), found=problem, fix="Download the file again")


class NotAnExampleError(ValueError):
    """The bytes are not a serialised tf.train.Example."""


def iterate_features(read: ReadBytes, start: int, length: int) -> Iterator[tuple[str, ByteRange]]:
    """Yield (name, position of the serialised tf.train.Feature) of each feature, in the order of the file.

    The file is read only as far as the caller iterates. No CRC is checked.

    Raises:
        NotAnExampleError: The bytes are not an Example.
    """
    end = start + length
    position = _find_content(read(start, _HEAD_BYTES), start, end, _FIRST) if length else end
    while position < end:
        head = read(position, _ENTRY_HEAD_BYTES)
        size, used = _parse_field_head(head, 0, _FIRST)
        name_length, name_start = _parse_field_head(head, used, _FIRST)
        name_end = name_start + name_length
        feature_length, feature_start = _parse_field_head(head, name_end, _SECOND)
        entry_end = position + used + size
        if position + feature_start + feature_length != entry_end or entry_end > end:
            raise NotAnExampleError(f"the lengths in the feature at byte {position} are inconsistent")
        try:
            yield head[name_start:name_end].decode(), (position + feature_start, feature_length)
        except UnicodeDecodeError:
            raise NotAnExampleError(f"the name of a feature at byte {position} is not text") from None
        position = entry_end


def find_items(read: ReadBytes, feature: ByteRange, count: int | None = None) -> list[ByteRange]:
    """Return the positions of all (or the first `count`) images or texts of a feature, without reading them.

    Raises:
        NotAnExampleError: The feature is not a list of bytes, or damaged.
    """
    ranges: list[ByteRange] = []
    start, end = feature[0], sum(feature)
    position = _find_content(read(start, _HEAD_BYTES), start, end, _FIRST) if start < end else end
    while position < end and len(ranges) != count:
        length, used = _parse_field_head(read(position, _HEAD_BYTES), 0, _FIRST)
        ranges.append((position + used, length))
        position += used + length
    if position > end:
        raise NotAnExampleError(f"the item at byte {ranges[-1][0]} extends beyond its list")
    return ranges


def decode_feature(data: bytes) -> tuple[Kind | None, Sequence[Any] | np.ndarray]:
    """Parse a serialised tf.train.Feature; return its kind (None if it has no values) and its values.

    Raises:
        NotAnExampleError: The bytes are not a Feature.
    """
    if not data:
        return None, ()
    if data[0] == _FIRST:
        ranges = find_items(lambda offset, length: data[offset : offset + length], (0, len(data)))
        return "bytes_list", [data[offset : offset + length] for offset, length in ranges]
    content = data[_find_content(data, 0, len(data), _SECOND if data[0] == _SECOND else _THIRD) :]
    packed = content[_find_content(content, 0, len(content), _FIRST) :] if content else b""
    if data[0] == _THIRD:
        return "int64_list", _decode_integers(packed)
    if len(packed) % 4:
        raise NotAnExampleError(f"{len(packed)} bytes of floats are not a multiple of 4")
    return "float_list", np.frombuffer(packed, "<f4")


def write_record(file: BinaryIO, data: bytes) -> None:
    """Append one record to a file."""
    header = struct.pack("<Q", len(data))
    file.write(header + struct.pack("<I", _masked_crc(header)))
    file.write(data)
    file.write(struct.pack("<I", _masked_crc(data)))


def encode_example(features: Mapping[str, tuple[Kind, Sequence[Any] | np.ndarray]]) -> bytes:
    """Serialise a tf.train.Example. Features are sorted as by protobuf: a name precedes every prefix of the name."""
    names = sorted(features, key=lambda name: name.encode() + b"\xff")
    entries = [encode_entry(name, *features[name]) for name in names]
    return encode_field(_FIRST, b"".join(entries))


def encode_entry(name: str, kind: Kind, values: Sequence[Any] | np.ndarray) -> bytes:
    """Serialise one feature with its name, as an entry of an Example."""
    if kind == "bytes_list":
        content = b"".join(encode_field(_FIRST, value) for value in values)
    elif kind == "float_list":
        content = encode_field(_FIRST, np.asarray(values, "<f4").tobytes()) if len(values) else b""
    else:
        content = encode_field(_FIRST, b"".join(_encode_varint(int(value)) for value in values)) if len(values) else b""
    feature = encode_field((_KINDS.index(kind) + 1) << 3 | 2, content)
    return encode_field(_FIRST, encode_field(_FIRST, name.encode()) + encode_field(_SECOND, feature))


def _truncated_error(where: str, size: int, needed: int) -> InputError:
    problem = f"the file is truncated: it ends after {size:,} bytes, within this record"
    return InputError(where=where, found=problem, needed=f"at least {needed:,} bytes", fix="Download the file again")


def _masked_crc(data: bytes) -> int:
    return _mask(int(google_crc32c.value(data)))


def _mask(crc: int) -> int:
    return ((crc >> 15 | crc << 17) + _MASK_DELTA) & 0xFFFFFFFF


def _parse_field_head(data: bytes, offset: int, tag: int) -> tuple[int, int]:
    """Parse the head of a length-delimited field at an offset; return its length and the offset of its content."""
    if offset < len(data) and data[offset] == tag:
        return _decode_varint(data, offset + 1)
    raise NotAnExampleError(f"field {tag >> 3} is missing at its expected position")


def _find_content(head: bytes, start: int, end: int, tag: int) -> int:
    """Return the offset of the content of a field that must fill its message from `start` to `end`."""
    length, used = _parse_field_head(head, 0, tag)
    if start + used + length != end:
        raise NotAnExampleError(f"the field at byte {start} does not end at the end of its message")
    return start + used


def _decode_integers(packed: bytes) -> Sequence[int] | np.ndarray:
    """Decode packed varints to signed 64-bit integers."""
    if packed.isascii():  # every varint is one byte, such as for flags
        return np.frombuffer(packed, np.uint8)
    integers, offset = [], 0
    while offset < len(packed):
        value, offset = _decode_varint(packed, offset)
        value &= (1 << 64) - 1
        integers.append(value - (1 << 64) if value >> 63 else value)
    return integers


def _decode_varint(data: bytes, start: int) -> tuple[int, int]:
    """Decode a varint; return its value and the offset of its end."""
    value = 0
    for index, byte in enumerate(data[start : start + _VARINT_BYTES]):
        value |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return value, start + index + 1
    raise NotAnExampleError(f"a varint is longer than {_VARINT_BYTES} bytes or truncated")


def _encode_varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    digits = bytearray()
    while value >= 0x80:
        digits.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*digits, value])


def encode_field(tag: int, content: bytes) -> bytes:
    """Serialise a length-delimited field."""
    return bytes([tag]) + _encode_varint(len(content)) + content
