"""TFRecord files read completely: the positions of all records, and all features of one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vjepa2_ac.data.sources.rlds_shards import find_shards
from vjepa2_ac.data.sources.tfrecord import (
    HEADER_BYTES,
    Kind,
    RecordSpan,
    decode_feature,
    encode_entry,
    encode_field,
    iterate_features,
    parse_header,
    verify_crc,
    write_record,
)


def index_records(path: str | Path) -> list[RecordSpan]:
    """Return the positions of a file's records."""
    data = Path(path).read_bytes()
    spans: list[RecordSpan] = []
    offset = 0
    while offset < len(data):
        header = data[offset : offset + HEADER_BYTES]
        spans.append(parse_header(header, str(path), len(spans), offset, len(data)))
        offset = spans[-1].end
    return spans


def index_set(folder: str | Path) -> list[RecordSpan]:
    """Return the positions of a data set's records, shard by shard."""
    return [span for shard in find_shards(str(folder)) for span in index_records(shard.path)]


def read_record(span: RecordSpan) -> bytes:
    """Return the data of one record, whose CRC is checked."""
    with Path(span.path).open("rb") as file:
        file.seek(span.offset)
        data = file.read(span.end - span.offset)
    verify_crc(lambda offset, length: data[offset - span.offset :][:length], span)
    return data[HEADER_BYTES:][: span.length]


def decode_example(data: bytes) -> dict[str, tuple[Kind | None, Sequence[Any] | np.ndarray]]:
    """Return kind and values of every feature of a serialised tf.train.Example."""
    located = iterate_features(lambda offset, length: data[offset : offset + length], 0, len(data))
    return {name: decode_feature(data[start : start + size]) for name, (start, size) in located}


def in_any_order(folder: Path, target: Path, seed: int) -> Path:
    """Write a copy of a data set with the features of each record in random order; TFDS orders them by a hash."""
    target.mkdir()
    generator = np.random.default_rng(seed)
    for file in folder.iterdir():
        if ".tfrecord-" not in file.name:
            (target / file.name).write_bytes(file.read_bytes())
            continue
        with (target / file.name).open("wb") as stream:
            for span in index_records(file):
                features = decode_example(read_record(span))
                entries = b"".join(
                    encode_entry(name, *features[name]) for name in generator.permutation(list(features))
                )
                write_record(stream, encode_field(0x0A, entries))
    return target
