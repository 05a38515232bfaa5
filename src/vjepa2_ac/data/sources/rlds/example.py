"""The content of one record of a data set, feature by feature."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float32

from vjepa2_ac.data.sources.rlds import wire_format
from vjepa2_ac.data.sources.rlds.tfrecord import Kind, RecordSpan, decode_feature
from vjepa2_ac.data.sources.rlds.wire_format import Located, NotAnExampleError, Read
from vjepa2_ac.errors import InputError


class ExampleRecord:
    """The features of one Example, read on request.

    Args:
        read: Returns bytes of the file.
        span: The record's position in it.
        located: The position of each feature, if known already.
    """

    def __init__(self, read: Read, span: RecordSpan, located: dict[str, Located] | None = None) -> None:
        self._read, self._span = read, span
        if located is not None:
            self.located = located

    @cached_property
    def located(self) -> dict[str, Located]:
        """The position of each feature."""
        try:
            return dict(wire_format.iterate_features(self._read, self._span.data_offset, self._span.length))
        except NotAnExampleError as error:
            raise not_an_example(self._span, error) from None

    def require(self, names: Iterable[str]) -> None:
        """Refuse a record that lacks a feature.

        Raises:
            InputError: It does; names the features that it has.
        """
        for name in names:
            if name not in self.located:
                known = sorted(self.located)
                close = difflib.get_close_matches(name, known, n=1)
                raise InputError(
                    where=str(self._span),
                    found=f"no feature {name}; the record has {', '.join(known) or 'none'}",
                    needed="the features that data.fields names",
                    fix=f"Did you mean {close[0]}? Set data.fields" if close else "Set data.fields",
                )

    def floats(self, name: str) -> Float32[np.ndarray, " values"]:
        """Return the numbers of a feature.

        Raises:
            InputError: There is no such feature, or it has no floats.
        """
        packed = wire_format.packed_numbers(self.serialised(name), wire_format.FLOAT_LIST)
        if packed is None or len(packed) % 4:
            return np.asarray(self.values(name, "float_list"), np.float32)
        return np.frombuffer(packed, "<f4")

    def is_float(self, name: str) -> bool:
        """Return whether a feature has floats, judged by its first byte."""
        return self._read(self.located[name].offset, 1) == bytes([wire_format.FLOAT_LIST << 3 | wire_format.DELIMITED])

    def count_integers(self, name: str) -> int:
        """Return the number of integers in a feature.

        Raises:
            InputError: There is no such feature, or it has no integers.
        """
        packed = wire_format.packed_numbers(self.serialised(name), wire_format.INT64_LIST)
        if packed is None or (packed and packed[-1] >= 0x80):
            return len(self.values(name, "int64_list"))
        return int(np.count_nonzero(np.frombuffer(packed, np.uint8) < 0x80))

    def items(self, name: str, count: int | None = None) -> tuple[list[int], list[int]]:
        """Return offsets and lengths of the texts or images of a feature, of the first `count`, without reading them.

        Raises:
            InputError: There is no such feature, or it has another type.
        """
        self.require([name])
        try:
            return wire_format.locate_items(self._read, self.located[name], count)
        except NotAnExampleError as error:
            self.values(name, "bytes_list")  # has a better message, if it raises
            raise not_an_example(self._span, error) from None

    def first_text(self, name: str) -> str:
        """Return the first text of a feature; empty if it has none.

        Raises:
            InputError: There is no such feature, or it has another type.
        """
        for offset, length in zip(*self.items(name, 1), strict=True):
            return self._read(offset, length).decode(errors="replace")
        return ""

    def values(self, name: str, *kinds: Kind) -> Sequence[Any]:
        """Return a feature's values, in any valid encoding.

        Raises:
            InputError: There is no such feature, or it has values of another type.
        """
        data = self.serialised(name)
        where = f"{self._span}: {name}"
        found, values = decode_feature(data, where=where)
        if found is not None and found not in kinds:
            raise InputError(where=where, found=f"a {found}", needed=f"a {' or '.join(kinds)}", fix="Check data.fields")
        return values

    def serialised(self, name: str) -> bytes:
        """Return the bytes of a feature in the file.

        Raises:
            InputError: There is no such feature, or the file ends within it.
        """
        self.require([name])
        offset, length = self.located[name]
        data = self._read(offset, length)
        if len(data) < length:
            where, found = f"{self._span}: {name}", f"{len(data)} bytes at {offset}"
            raise InputError(where=where, found=found, needed=f"{length} bytes")
        return data


def not_an_example(span: RecordSpan, error: NotAnExampleError) -> InputError:
    """Return the error of a record that cannot be read as features."""
    return InputError(where=str(span), found=f"not a tf.train.Example ({error})", needed="an RLDS data set")
