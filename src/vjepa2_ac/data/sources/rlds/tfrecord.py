"""TFRecord files of tf.train.Examples, read and written without TensorFlow.

A file is a sequence of records: u64 little-endian length, masked CRC-32C of the length, data, masked CRC-32C of the
data. The data of each record is one tf.train.Example: a map from feature names to lists of bytes, floats or integers.

Source: tensorflow/tensorflow, tensorflow/core/lib/io/record_writer.h and core/example/{example,feature}.proto (the
formats; no code).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import google_crc32c
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from vjepa2_ac import storage
from vjepa2_ac.errors import InputError

Kind = Literal["bytes_list", "float_list", "int64_list"]

HEADER_BYTES = 12
_FOOTER_BYTES = 4
_PIECE_BYTES = 1 << 18  # small enough to stay in the processor's cache between reading and checking
_MASK_DELTA = 0xA282EAD8


@dataclass(frozen=True)
class RecordSpan:
    """The position of one record in its file."""

    path: str
    number: int
    offset: int  # of its header
    length: int  # of its data

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


def span_at(header: bytes, path: str, number: int, offset: int, size: int) -> RecordSpan:
    """Return the position of a record, from the bytes at its offset.

    Args:
        header: At least the first 12 bytes of the record, if the file has them.
        path: The file, for messages.
        number: Of the record in the file.
        offset: Of the record in the file.
        size: Of the file.

    Raises:
        InputError: The CRC of the length does not match, or the file ends within the record.
    """
    where = f"{path}: record {number} at byte {offset}"
    if len(header) < HEADER_BYTES:
        raise _truncated(where, size, offset + HEADER_BYTES)
    length, crc = struct.unpack_from("<QI", header)
    if crc != _masked_crc(header[:8]):
        raise InputError(
            where=where,
            found="the CRC of the length does not match: not a TFRecord file, or a damaged one",
            needed="a TFRecord file as TFDS writes it",
        )
    span = RecordSpan(path=path, number=number, offset=offset, length=length)
    if span.end > size:
        raise _truncated(where, size, span.end)
    return span


def require_intact(read: Callable[[int, int], bytes], span: RecordSpan) -> None:
    """Check the CRC of a record's data, read in chunks.

    Args:
        read: Returns bytes of the file: (offset, length) -> those bytes, fewer if the file ends.
        span: The record.

    Raises:
        InputError: The file ends within the record, or its CRC does not match.
    """
    crc, position, end = 0, span.data_offset, span.end - _FOOTER_BYTES
    while position < end:
        piece = read(position, min(_PIECE_BYTES, end - position))
        if not piece:
            raise _truncated(str(span), position, span.end)
        crc = google_crc32c.extend(crc, piece)
        position += len(piece)
    footer = read(end, _FOOTER_BYTES)
    if len(footer) < _FOOTER_BYTES:
        raise _truncated(str(span), end + len(footer), span.end)
    if _mask(crc) != struct.unpack("<I", footer)[0]:
        raise _damaged(span)


def index_records(path: str | Path) -> list[RecordSpan]:
    """Return the positions of a file's records, reading only their headers.

    Raises:
        InputError: The file cannot be read, is not a TFRecord, is damaged in a header, or ends within a record.
    """
    try:
        size = storage.file_size(path)
        with closing(storage.open_to_read(path)) as file:
            return _hop_headers(file, str(path), size)
    except OSError as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", needed="a TFRecord file") from None


def read_record(span: RecordSpan, *, check_crc: bool = True) -> bytes:
    """Return the data of one record.

    Raises:
        InputError: The file cannot be read, ends within the record, or its CRC does not match.
    """
    wanted = span.length + _FOOTER_BYTES
    try:
        data = storage.read_range(span.path, span.data_offset, wanted)
    except OSError as error:
        raise InputError(where=str(span), found=f"cannot be read ({error})") from None
    if len(data) < wanted:
        raise _truncated(str(span), span.data_offset + len(data), span.end)
    record = data[: span.length]
    if check_crc and _masked_crc(record) != struct.unpack_from("<I", data, span.length)[0]:
        raise _damaged(span)
    return record


def write_record(file: BinaryIO, data: bytes) -> None:
    """Append one record to a file."""
    header = struct.pack("<Q", len(data))
    file.write(header + struct.pack("<I", _masked_crc(header)))
    file.write(data)
    file.write(struct.pack("<I", _masked_crc(data)))


def encode_example(features: Mapping[str, tuple[Kind, Sequence[Any] | np.ndarray]]) -> bytes:
    """Return a serialised tf.train.Example; equal features give equal bytes."""
    example = _Example()
    for name, (kind, values) in features.items():
        values = values.tolist() if isinstance(values, np.ndarray) else values
        getattr(example.features.feature[name], kind).value.extend(values)
    return bytes(example.SerializeToString(deterministic=True))


def decode_example(data: bytes, *, where: str) -> dict[str, tuple[Kind | None, Sequence[Any]]]:
    """Return every feature of a serialised tf.train.Example: its kind (None: an empty feature) and its values.

    Raises:
        InputError: The bytes are not an Example.
    """
    try:
        example = _Example.FromString(data)
    except DecodeError:
        raise InputError(where=where, found="not a tf.train.Example", needed="an RLDS data set") from None
    return {name: _values(feature) for name, feature in example.features.feature.items()}


def decode_feature(data: bytes, *, where: str) -> tuple[Kind | None, Sequence[Any]]:
    """Return kind and values of one serialised tf.train.Feature.

    Raises:
        InputError: The bytes are not a Feature.
    """
    try:
        return _values(_Feature.FromString(data))
    except DecodeError:
        raise InputError(where=where, found="not a tf.train.Feature", needed="an RLDS data set") from None


def _hop_headers(file: storage.ByteReader, path: str, size: int) -> list[RecordSpan]:
    spans: list[RecordSpan] = []
    offset = 0
    while offset < size:
        file.seek(offset)
        spans.append(span_at(file.read(HEADER_BYTES), path, len(spans), offset, size))
        offset = spans[-1].end
    return spans


def _truncated(where: str, size: int, needed: int) -> InputError:
    return InputError(
        where=where,
        found=f"the file ends after {size:,} bytes, within this record: it is truncated",
        needed=f"at least {needed:,} bytes",
        fix="Download the file again",
    )


def _damaged(span: RecordSpan) -> InputError:
    return InputError(
        where=str(span),
        found="the CRC of the data does not match: the file is damaged",
        fix="Download the file again",
    )


def _masked_crc(data: bytes) -> int:
    return _mask(int(google_crc32c.value(data)))


def _mask(crc: int) -> int:
    return ((crc >> 15 | crc << 17) + _MASK_DELTA) & 0xFFFFFFFF


def _values(feature: Any) -> tuple[Kind | None, Sequence[Any]]:
    kind = feature.WhichOneof("kind")
    return kind, getattr(feature, kind).value if kind else ()


def _declare_example() -> dict[str, Any]:
    """Declare tf.train.Example in a separate pool: no generated file, no conflict with TensorFlow's declaration."""
    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="example.proto", package="tensorflow", syntax="proto3")
    one, many = field.LABEL_OPTIONAL, field.LABEL_REPEATED

    def add(message: Any, name: str, number: int, label: Any, kind: Any, type_name: str | None = None) -> Any:
        return message.field.add(name=name, number=number, label=label, type=kind, type_name=type_name)

    kinds = (("BytesList", field.TYPE_BYTES), ("FloatList", field.TYPE_FLOAT), ("Int64List", field.TYPE_INT64))
    for name, kind in kinds:
        add(file.message_type.add(name=name), "value", 1, many, kind)
    feature = file.message_type.add(name="Feature")
    feature.oneof_decl.add(name="kind")
    for number, (name, _) in enumerate(kinds, start=1):
        member = add(feature, name[:-4].lower() + "_list", number, one, field.TYPE_MESSAGE, f".tensorflow.{name}")
        member.oneof_index = 0
    features = file.message_type.add(name="Features")
    entry = features.nested_type.add(name="FeatureEntry")
    entry.options.map_entry = True
    add(entry, "key", 1, one, field.TYPE_STRING)
    add(entry, "value", 2, one, field.TYPE_MESSAGE, ".tensorflow.Feature")
    add(features, "feature", 1, many, field.TYPE_MESSAGE, ".tensorflow.Features.FeatureEntry")
    add(file.message_type.add(name="Example"), "features", 1, one, field.TYPE_MESSAGE, ".tensorflow.Features")

    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    find = pool.FindMessageTypeByName
    return {name: message_factory.GetMessageClass(find(f"tensorflow.{name}")) for name in ("Example", "Feature")}


_MESSAGES = _declare_example()
_Example, _Feature = _MESSAGES["Example"], _MESSAGES["Feature"]
