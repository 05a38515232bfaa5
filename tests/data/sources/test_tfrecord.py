"""TFRecords: written records are read back unchanged, and bytes of other formats raise an error."""

from collections.abc import Callable
from pathlib import Path

import google_crc32c
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tfrecords import decode_example
from vjepa2_ac.data.sources.tfrecord import (
    NotAnExampleError,
    decode_feature,
    encode_example,
    iterate_features,
    write_record,
)


def reader_of(data: bytes) -> Callable[[int, int], bytes]:
    return lambda offset, length: data[offset : offset + length]


def test_record_framing_matches_the_specification(tmp_path: Path) -> None:
    """CRC-32C of eight zero bytes is 0x8c28b28a; the mask rotates right by 15 and adds 0xa282ead8."""
    assert google_crc32c.value(bytes(8)) == 0x8C28B28A
    masked = (((0x8C28B28A >> 15) | (0x8C28B28A << 17)) + 0xA282EAD8) & 0xFFFFFFFF
    with (tmp_path / "file").open("wb") as stream:
        write_record(stream, b"")
    encoded = (tmp_path / "file").read_bytes()
    assert encoded[:12] == bytes(8) + masked.to_bytes(4, "little")
    assert len(encoded) == 16


features = st.dictionaries(
    st.text(min_size=1, max_size=10),
    st.one_of(
        st.tuples(st.just("bytes_list"), st.lists(st.binary(max_size=300), max_size=5)),
        st.tuples(st.just("float_list"), st.lists(st.floats(width=32, allow_nan=False), max_size=50)),
        st.tuples(st.just("int64_list"), st.lists(st.integers(-(2**63), 2**63 - 1), max_size=50)),
    ),
    max_size=6,
)


@settings(max_examples=50)
@given(features=features)
def test_features_are_located_without_reading_other_features(features: dict) -> None:
    data = b"before" + encode_example(features) + b"after"
    feature_ranges = dict(iterate_features(reader_of(data), 6, len(data) - 11))
    assert feature_ranges.keys() == features.keys()
    for name, (kind, values) in features.items():
        offset, length = feature_ranges[name]
        decoded_kind, decoded_values = decode_feature(data[offset : offset + length])
        assert list(decoded_values) == values
        assert decoded_kind == kind
    decoded = decode_example(data[6:-5])
    assert {name: list(values) for name, (_, values) in decoded.items()} == {n: v for n, (_, v) in features.items()}


def test_encoded_example_equals_protobuf_output() -> None:
    """The bytes are those of protobuf 7.36.2 with deterministic=True."""
    features = {"a": ("int64_list", [1, -1, 300]), "a/b": ("float_list", [1.0, -2.5]), "none": ("float_list", [])}
    encoded = (
        "0a4a0a130a03612f62120c120a0a080000803f000020c00a160a016112111a0f0a0d01ffffffffffffffffff01ac02"
        "0a0a0a046e6f6e65120212000a0f0a047465787412070a050a01780a00"
    )
    assert encode_example({**features, "text": ("bytes_list", [b"x", b""])}).hex() == encoded


def test_bytes_that_are_not_an_example_raise() -> None:
    example = encode_example({"name": ("bytes_list", [b"value" * 10])})
    for length in range(1, len(example)):
        with pytest.raises(NotAnExampleError):
            dict(iterate_features(reader_of(example), 0, length))
    for damaged in (b"\xff\xff", b"\x0a\x02", b"\x12\x02\x0a\x03", b"\x12\x05\x0a\x03abc", b"\x1a\x03\x0a\x01\x80"):
        with pytest.raises(NotAnExampleError):
            decode_feature(damaged)
