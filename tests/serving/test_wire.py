"""The wire format: messages survive encoding and decoding, and invalid messages are rejected at low cost."""

import contextlib
import math
import tracemalloc

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from vjepa2_ac.serving import wire
from vjepa2_ac.serving.wire import WireError, pack, unpack

TYPES = ["u1", "i1", "<u2", "<u4", "<u8", "<i2", "<i4", "<i8", "<f2", "<f4", "<f8", "?"]
ARRAYS = st.sampled_from(TYPES).flatmap(
    lambda kind: arrays(np.dtype(kind), array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))
)
PLAIN = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=20)
    | st.binary(max_size=20)
)
VALUES = st.recursive(PLAIN | ARRAYS, lambda inner: st.lists(inner, max_size=4), max_leaves=8)
MESSAGES = st.dictionaries(st.text(max_size=10), VALUES, max_size=6)


def array_of(dtype: object = "<f4", shape: object = (2,), data: object = b"\0" * 8, **fields: object) -> bytes:
    return msgpack.packb({"a": {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape, **fields}})


@given(MESSAGES)
def test_message_survives_encoding_and_decoding(message) -> None:
    decoded = unpack(pack(message))
    np.testing.assert_equal(decoded, dict(message))


def test_decoded_arrays_keep_their_type_and_are_writable() -> None:
    decoded = unpack(pack({"a": np.arange(6, dtype=np.float32).reshape(2, 3)[:, ::2], "n": np.float64(0.1)}))
    assert decoded["a"].dtype == np.float32
    assert decoded["a"].flags.writeable
    np.testing.assert_array_equal(decoded["a"], [[0, 2], [3, 5]])
    assert decoded["n"] == 0.1


HOSTILE = {
    "nothing": b"",
    "an undefined byte": b"\xc1",
    "a list": msgpack.packb([1, 2]),
    "a number": b"\x01",
    "an array without a map": msgpack.packb({b"__ndarray__": True, b"data": b"\0", b"dtype": "|u1", b"shape": [1]}),
    "two messages": pack({"a": 1}) + pack({"a": 1}),
    "half a message": pack({"a": np.zeros(5)})[:-3],
    "a number as key": msgpack.packb({1: 2}),
    "bytes as key": msgpack.packb({b"a": 2}),
    "a list as key": b"\x81\x90\x01",
    "a key twice": b"\x82\xa1a\x01\xa1a\x02",
    "an extension": msgpack.packb({"a": msgpack.ExtType(3, b"x")}),
    "a time": msgpack.packb({"a": msgpack.Timestamp(3)}),
    "invalid UTF-8": b"\x81\xa1\xff\x01",
    "surrogates": b"\x81\xa1a\xa3\xed\xa0\x80",
    "deep lists": b"\x81\xa1a" + b"\x91" * 500 + b"\x01",
    "deeper lists": b"\x81\xa1a" + b"\x91" * 100_000 + b"\x01",
    "deep maps": b"\x81\xa1a" * 900 + b"\x01",
    "very many empty maps": b"\x81\xa1a\xdd\x00\x40\x00\x00" + b"\x80" * (4 << 20),
    "maps in lists in lists": msgpack.packb({"a": [[{} for _ in range(60)] for _ in range(60)]}),
    "a list that claims to be long": b"\x81\xa1a\xdd\xff\xff\xff\xff",
    "a map that claims to be long": b"\xdf\xff\xff\xff\xff",
    "bytes that claim to be long": b"\x81\xa1a\xc6\xff\xff\xff\xff",
    "a long text": msgpack.packb({"a": "x" * 5000}),
    "objects": array_of("|O"),
    "objects of eight bytes": array_of("|O8"),
    "items of zero bytes": array_of("|V0", [2**40], b""),
    "records": array_of("<f4,<f4"),
    "a list of types": array_of([["a", "<f4"]]),
    "other byte order": array_of(">f4"),
    "texts": array_of("<U2"),
    "dates": array_of("<M8[s]"),
    "complex": array_of("<c8"),
    "long floats": array_of("<f16", (1,), b"\0" * 16),
    "no type": array_of(None),
    "too few bytes": array_of(shape=(3,)),
    "too many bytes": array_of(shape=(1,)),
    "negative sides": array_of(shape=(-2, -1)),
    "one negative side": array_of(shape=(-2,)),
    "a side that is a float": array_of(shape=(2.0,)),
    "a side that is a boolean": array_of("|u1", (True,), b"\0"),
    "huge sides of an empty array": array_of(shape=(2**62, 0), data=b""),
    "five dimensions": array_of(shape=(1, 1, 1, 1, 2)),
    "a shape that is a number": array_of(shape=2),
    "a shape that is an array": array_of(shape={b"__ndarray__": True, b"data": b"\2", b"dtype": "|u1", b"shape": [1]}),
    "data that are text": array_of(data="12345678"),
    "an unknown key": array_of(extra=1),
    "a marker that is not true": msgpack.packb(
        {"a": {b"__ndarray__": 1, b"data": b"", b"dtype": "|u1", b"shape": [0]}}
    ),
    "a scalar that is a list": msgpack.packb({"a": {b"__npgeneric__": True, b"data": [1], b"dtype": "<f4"}}),
    "a scalar of type object": msgpack.packb({"a": {b"__npgeneric__": True, b"data": 1, b"dtype": "|O"}}),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_message_raises_without_allocating_memory(name: str) -> None:
    message = HOSTILE[name]
    tracemalloc.start()
    try:
        with pytest.raises(WireError) as caught:
            unpack(message)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()
    assert len(str(caught.value)) < 200


def test_too_large_message_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire, "MAX_MESSAGE_BYTES", 1000)
    with pytest.raises(WireError, match=r"the message has 1,0.. bytes. Expected at most 1,000"):
        unpack(pack({"a": np.zeros(1000, dtype=np.uint8)}))


GOOD = pack({
    "observation/image": np.zeros((4, 4, 3), dtype=np.uint8), "observation/state": np.zeros(7), "prompt": "cup",
    "reset": False, "goal/rules": [{"at_most": 1}, {}],
})  # fmt: skip


@settings(max_examples=2000)
@given(
    st.lists(st.tuples(st.integers(0, len(GOOD) - 1), st.integers(0, 255)), min_size=1, max_size=6),
    st.integers(0, len(GOOD)),
)
def test_mutated_message_is_decoded_or_raises_wire_error(changes, cut) -> None:
    message = bytearray(GOOD)
    for index, value in changes:
        message[index] = value
    for data in (bytes(message), bytes(message[:cut])):
        try:
            decoded = unpack(data)
        except WireError:
            continue
        assert isinstance(decoded, dict)


@settings(max_examples=1000)
@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_decoded_or_raise_wire_error(message) -> None:
    with contextlib.suppress(WireError):
        assert isinstance(unpack(message), dict)


def test_unsupported_value_raises_in_pack() -> None:
    for wrong in (np.array(["a"]), np.array([None]), object(), np.array([1j])):
        with pytest.raises(TypeError, match="cannot be sent"):
            pack({"a": wrong})
    assert math.isnan(unpack(pack({"a": math.nan}))["a"])
