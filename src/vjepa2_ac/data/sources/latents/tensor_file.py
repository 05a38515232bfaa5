"""A safetensors file, here or behind a URL, of which only the header and the requested rows are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import torch
from torch import Tensor

from vjepa2_ac.storage.structured import MOST_BYTES, json_object

Ranges = Sequence[tuple[int, int]]  # (start, length) in bytes

_HEAD_BYTES = 32 << 10  # read when it is opened: the header, and with it most small tensors
_LENGTH_BYTES = 8  # before the header: how long it is
_DTYPES = {
    "BF16": torch.bfloat16, "F16": torch.float16, "F32": torch.float32, "F64": torch.float64, "BOOL": torch.bool,
    "U8": torch.uint8, "I8": torch.int8, "I16": torch.int16, "I32": torch.int32, "I64": torch.int64,
}  # fmt: skip


@dataclass(frozen=True)
class _Entry:
    """A tensor of the header."""

    dtype: torch.dtype
    shape: tuple[int, ...]
    start: int  # in the file

    @classmethod
    def of(cls, about: Mapping[str, Any], begin: int) -> _Entry:
        """Return a tensor of a header; `begin`: where the header ends."""
        start, end = about["data_offsets"]
        one = cls(_DTYPES[about["dtype"]], tuple(about["shape"]), begin + start)
        if min(start, *one.shape) < 0 or one.end != begin + end:
            raise ValueError(f"shape {one.shape} in bytes {start} to {end}")
        return one

    @property
    def end(self) -> int:
        """Where it ends in the file."""
        return self.start + prod(self.shape) * self.dtype.itemsize

    def range_of(self, start: int, stop: int) -> tuple[int, int]:
        """Return where some of its rows are."""
        if not 0 <= start <= stop <= self.shape[0]:
            raise IndexError(f"rows {start} to {stop} of {self.shape[0]}")
        row = prod(self.shape[1:]) * self.dtype.itemsize
        return self.start + start * row, (stop - start) * row


class TensorFile:
    """A safetensors file whose header was read; a wrong one is a ValueError, KeyError, TypeError or IndexError.

    Args:
        read: Returns several pieces of the file, each complete.
        size: The file's.
        where: Its name, for messages.
    """

    def __init__(self, read: Callable[[Ranges], list[bytes]], size: int, where: str) -> None:
        self._read, self._head = read, b""
        self._head = self._pieces([(0, min(size, _HEAD_BYTES))])[0]
        begin = _LENGTH_BYTES + int.from_bytes(self._head[:_LENGTH_BYTES], "little")
        if not _LENGTH_BYTES < begin <= min(size, MOST_BYTES):
            raise ValueError("no header")
        header = json_object(self._pieces([(_LENGTH_BYTES, begin - _LENGTH_BYTES)])[0], where=where)
        self.metadata: Mapping[str, str] = header.pop("__metadata__", {})
        self._entries = {name: _Entry.of(about, begin) for name, about in header.items()}
        if (end := max([begin, *(one.end for one in self._entries.values())])) != size:
            raise ValueError(f"{size:,} bytes of {end:,}")

    @property
    def names(self) -> frozenset[str]:
        """The names of its tensors."""
        return frozenset(self._entries)

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a tensor."""
        return self._entries[name].shape

    def tensor(self, name: str) -> Tensor:
        """Return a whole tensor."""
        one = self._entries[name]
        return _tensor(self._pieces([(one.start, one.end - one.start)]), one, one.shape)

    def rows(self, names: Sequence[str], places: Sequence[int]) -> list[Tensor]:
        """Return the same rows of several tensors, which are read together."""
        entries = [self._entries[name] for name in names]
        pieces = self._pieces([one.range_of(place, place + 1) for one in entries for place in places])
        count = len(places)
        return [
            _tensor(pieces[i * count : (i + 1) * count], one, (count, *one.shape[1:])) for i, one in enumerate(entries)
        ]

    def slices(self, name: str, bounds: Sequence[tuple[int, int]]) -> list[bytes]:
        """Return the bytes of rows from the first to before the second number of each pair, read together."""
        return self._pieces([self._entries[name].range_of(*pair) for pair in bounds])

    def _pieces(self, ranges: Ranges) -> list[bytes]:
        known, there = len(self._head), dict[tuple[int, int], bytes]()
        for start, length in ranges:
            if start + length <= known or not length:
                there[start, length] = self._head[start : start + length]
        lacking = [one for one in dict.fromkeys(ranges) if one not in there]
        there |= zip(lacking, self._read(lacking), strict=True) if lacking else ()
        return [there[one] for one in ranges]


def _tensor(pieces: Sequence[bytes], like: _Entry, shape: tuple[int, ...]) -> Tensor:
    data = bytearray().join(pieces)  # one that can be written to
    return torch.frombuffer(data, dtype=like.dtype).reshape(shape) if data else torch.empty(shape, dtype=like.dtype)
