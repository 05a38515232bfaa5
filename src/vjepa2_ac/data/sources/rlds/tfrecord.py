"""TFRecord files of tf.train.Examples, read and written without TensorFlow.

A file is a sequence of records: u64 little-endian length, masked CRC-32C of the length, data, masked CRC-32C of the
data. The data of each record is one tf.train.Example: a map from feature names to lists of bytes, floats or integers.

Source: tensorflow/tensorflow, tensorflow/core/lib/io/record_writer.h and core/example/{example,feature}.proto (the
formats; no code).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO, Literal

import google_crc32c
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format
from google.protobuf.message import DecodeError

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
        found = "the CRC of the length does not match: not a TFRecord file, or a damaged one"
        raise InputError(where=where, found=found, needed="a TFRecord file as TFDS writes it")
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
        found = "the CRC of the data does not match: the file is damaged"
        raise InputError(where=str(span), found=found, fix="Download the file again")


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


def decode_feature(data: bytes, *, where: str) -> tuple[Kind | None, Sequence[Any]]:
    """Return kind and values of one serialised tf.train.Feature.

    Raises:
        InputError: The bytes are not a Feature.
    """
    try:
        feature = _Feature.FromString(data)
    except DecodeError:
        raise InputError(where=where, found="not a tf.train.Feature", needed="an RLDS data set") from None
    kind = feature.WhichOneof("kind")
    return kind, getattr(feature, kind).value if kind else ()


def _truncated(where: str, size: int, needed: int) -> InputError:
    found = f"the file ends after {size:,} bytes, within this record: it is truncated"
    return InputError(where=where, found=found, needed=f"at least {needed:,} bytes", fix="Download the file again")


def _masked_crc(data: bytes) -> int:
    return _mask(int(google_crc32c.value(data)))


def _mask(crc: int) -> int:
    return ((crc >> 15 | crc << 17) + _MASK_DELTA) & 0xFFFFFFFF


# The message types, in their own pool: no generated file, and no conflict with TensorFlow's declaration.
_PROTO = """
name: "example.proto" package: "tensorflow" syntax: "proto3"
message_type { name: "BytesList" field { name: "value" number: 1 label: LABEL_REPEATED type: TYPE_BYTES } }
message_type { name: "FloatList" field { name: "value" number: 1 label: LABEL_REPEATED type: TYPE_FLOAT } }
message_type { name: "Int64List" field { name: "value" number: 1 label: LABEL_REPEATED type: TYPE_INT64 } }
message_type { name: "Feature" oneof_decl { name: "kind" }
  field { name: "bytes_list" number: 1 label: LABEL_OPTIONAL type_name: ".tensorflow.BytesList" oneof_index: 0 }
  field { name: "float_list" number: 2 label: LABEL_OPTIONAL type_name: ".tensorflow.FloatList" oneof_index: 0 }
  field { name: "int64_list" number: 3 label: LABEL_OPTIONAL type_name: ".tensorflow.Int64List" oneof_index: 0 }
}
message_type { name: "Features"
  nested_type { name: "FeatureEntry" options { map_entry: true }
    field { name: "key" number: 1 label: LABEL_OPTIONAL type: TYPE_STRING }
    field { name: "value" number: 2 label: LABEL_OPTIONAL type_name: ".tensorflow.Feature" }
  }
  field { name: "feature" number: 1 label: LABEL_REPEATED type_name: ".tensorflow.Features.FeatureEntry" }
}
message_type { name: "Example"
  field { name: "features" number: 1 label: LABEL_OPTIONAL type_name: ".tensorflow.Features" }
}
"""
_POOL = descriptor_pool.DescriptorPool()
_POOL.Add(text_format.Parse(_PROTO, descriptor_pb2.FileDescriptorProto()))
_Example: Any = message_factory.GetMessageClass(_POOL.FindMessageTypeByName("tensorflow.Example"))
_Feature: Any = message_factory.GetMessageClass(_POOL.FindMessageTypeByName("tensorflow.Feature"))
