"""What does one record of a data set hold, feature by feature?"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

from vjepa2_ac import storage
from vjepa2_ac.data.sources.example_index import NotAnExampleError, locate_features
from vjepa2_ac.data.sources.tfrecord import Kind, RecordSpan, decode_feature
from vjepa2_ac.errors import InputError


class Record:
    """The features of one Example, read from a file or from memory when asked for.

    Args:
        file: Where the Example is.
        span: The record it is from, for messages.
        start: Offset of the Example in the file.
    """

    def __init__(self, file: storage.ByteReader, span: RecordSpan, start: int) -> None:
        self._file, self._start, self._span = file, start, span

    @cached_property
    def located(self) -> dict[str, tuple[int, int]]:
        """Where each feature lies: offset and length."""
        try:
            return locate_features(self._file, self._start, self._span.length)
        except NotAnExampleError as error:
            raise InputError(
                where=str(self._span), found=f"not a tf.train.Example ({error})", needed="an RLDS data set"
            ) from None

    def require(self, names: Iterable[str]) -> None:
        """Refuse a record that lacks a feature."""
        for name in names:
            if name not in self.located:
                raise self._missing(name)

    def values(self, name: str, *kinds: Kind) -> Sequence[Any]:
        """Return a feature's values.

        Raises:
            InputError: There is no such feature, or it holds values of another kind.
        """
        if name not in self.located:
            raise self._missing(name)
        offset, length = self.located[name]
        self._file.seek(offset)
        where = f"{self._span}: {name}"
        found, values = decode_feature(self._file.read(length), where=where)
        if found is not None and found not in kinds:
            raise InputError(where=where, found=f"a {found}", needed=f"a {' or '.join(kinds)}", fix="Check data.fields")
        return values

    def _missing(self, name: str) -> InputError:
        names = sorted(self.located)
        close = difflib.get_close_matches(name, names, n=1)
        hint = f"Did you mean {close[0]}? " if close else ""
        return InputError(
            where=str(self._span),
            found=f"no feature {name}; the record has {', '.join(names) or 'none'}",
            needed="the features that data.fields names",
            fix=f"{hint}Set data.fields",
        )
