"""Reading of .npz files without trusting their content: all arrays, single ones, or single frames of one."""

from __future__ import annotations

import errno
import io
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from typing import IO, cast

import numpy as np
from jaxtyping import Shaped

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import ByteReader

_LOCAL_HEADER_BYTES = 30
_MOST_BYTES = 1 << 30  # of an array that is read completely
_DEFLATE_LIMIT = 1040  # DEFLATE compresses a thousandfold at most: a higher ratio is damage
_CHUNK_BYTES = 1 << 20
_MOST_HEADER_BYTES = 1 << 14  # numpy reads as much as a header claims, gigabytes, before it refuses 10,000 bytes
_KINDS = frozenset({zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED})  # as numpy writes; others have no bounded ratio
_FIX = "Write the file again, with numpy.savez"
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError, SyntaxError, EOFError, KeyError, ValueError,
    TypeError, OverflowError, MemoryError, NotImplementedError, RuntimeError,
)  # fmt: skip


@dataclass(frozen=True)
class ArrayHeader:
    """Shape and type of an array, and where its values begin in the archive's member."""

    shape: tuple[int, ...]
    dtype: np.dtype
    start: int
    by_columns: bool = False  # in Fortran order

    @property
    def row_bytes(self) -> int:
        """Size of one row."""
        return int(prod(self.shape[1:])) * self.dtype.itemsize


class NpzFile:
    """An .npz file open for reading. Nothing in it is ever unpickled.

    Raises:
        InputError: It is not an .npz file; each method raises it for damage, too.
    """

    def __init__(self, file: ByteReader, where: str) -> None:
        self._file, self._where = file, where
        with self._damage_is_named():
            self._archive = zipfile.ZipFile(cast("IO[bytes]", file))
            members = [info for info in self._archive.infolist() if info.filename.endswith(".npy")]
        self._members = {info.filename.removesuffix(".npy"): info for info in members}

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the arrays."""
        return tuple(self._members)

    def header(self, name: str) -> ArrayHeader:
        """Return shape and type of an array, without its values."""
        with self._damage_is_named(name), self._archive.open(self._members[name]) as member:
            if self._members[name].compress_type not in _KINDS:
                raise ValueError("packed in another way than numpy does")
            head = self._head(member)
            version = np.lib.format.read_magic(head)
            if version not in {(1, 0), (2, 0)}:
                raise ValueError(f"version {version} of the format")
            first = version == (1, 0)
            read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
            shape, by_columns, dtype = read(head)
            if dtype.hasobject:
                raise ValueError("an array of Python objects, which would have to be executed")
            header = ArrayHeader(tuple(int(size) for size in shape), dtype, head.tell(), by_columns)
            self._require_fitting(self._members[name], header)
            return header

    def header_of_rows(self, name: str) -> ArrayHeader:
        """Return the header of an array that must be stored row by row (C order)."""
        header = self.header(name)
        if header.by_columns and len(header.shape) > 1:
            raise InputError(
                where=f"{self._where}: {name}",
                found="an array in Fortran order, of which no rows can be read by themselves",
                needed="C order",
                fix="Write it with numpy.ascontiguousarray",
            )
        return header

    def array(self, name: str) -> Shaped[np.ndarray, ...]:
        """Return a complete array; its checksum is verified."""
        header = self.header(name)
        with self._damage_is_named(name), self._archive.open(self._members[name]) as member:
            if prod(header.shape) * header.dtype.itemsize > _MOST_BYTES:
                raise ValueError(f"shape {header.shape}, more than is ever read at once")
            values = member.read()[header.start :]
            return np.frombuffer(values, header.dtype).reshape(header.shape, order="F" if header.by_columns else "C")

    def rows(self, name: str, rows: Sequence[int]) -> Shaped[np.ndarray, "rows ..."]:
        """Return some rows of an array, in this order.

        Of an uncompressed array only these rows are read, and the checksum is not verified: it covers the whole array.
        A compressed one is decompressed up to the last of these rows; other rows are not stored.
        """
        header = self.header_of_rows(name)
        member = self._members[name]
        wanted = sorted(set(rows))
        stored = member.compress_type == zipfile.ZIP_STORED
        with self._damage_is_named(name):
            pieces = self._stored(member, header, wanted) if stored else self._unpacked(member, header, wanted)
            found = {row: np.frombuffer(piece, header.dtype) for row, piece in zip(wanted, pieces, strict=True)}
        return np.stack([found[row] for row in rows]).reshape(len(rows), *header.shape[1:])

    @staticmethod
    def _head(member: ByteReader) -> io.BytesIO:
        """Read an array's header for numpy, after checking its length."""
        start = member.read(np.lib.format.MAGIC_LEN)
        size = member.read(2 if start[-2:] == b"\x01\x00" else 4)
        length = int.from_bytes(size, "little")
        if length > _MOST_HEADER_BYTES:
            raise ValueError(f"a header of {length:,} bytes")
        return io.BytesIO(start + size + member.read(length))

    def _stored(self, member: zipfile.ZipInfo, header: ArrayHeader, rows: list[int]) -> Iterator[bytes]:
        """Yield rows of an uncompressed array, each from its position in the file."""
        self._file.seek(member.header_offset)
        local = self._exactly(self._file, _LOCAL_HEADER_BYTES)
        names = int.from_bytes(local[26:28], "little") + int.from_bytes(local[28:30], "little")
        values = member.header_offset + _LOCAL_HEADER_BYTES + names + header.start
        for row in rows:
            self._file.seek(values + row * header.row_bytes)
            yield self._exactly(self._file, header.row_bytes)

    def _unpacked(self, member: zipfile.ZipInfo, header: ArrayHeader, rows: list[int]) -> Iterator[bytes]:
        """Yield rows of a compressed array, decompressing it from its start."""
        with self._archive.open(member) as values:
            place = 0
            for row in rows:
                start = header.start + row * header.row_bytes
                while place < start:
                    place += len(self._exactly(values, min(_CHUNK_BYTES, start - place)))
                yield self._exactly(values, header.row_bytes)
                place += header.row_bytes

    @staticmethod
    def _exactly(file: ByteReader, size: int) -> bytes:
        data = file.read(size)
        if len(data) != size:
            raise EOFError(f"it ends {size - len(data)} bytes early")
        return data

    def _require_fitting(self, member: zipfile.ZipInfo, header: ArrayHeader) -> None:
        """Refuse inconsistent sizes before memory of that size is allocated."""
        promised = header.start + prod(header.shape) * header.dtype.itemsize
        if promised != member.file_size or member.file_size > member.compress_size * _DEFLATE_LIMIT + _CHUNK_BYTES:
            raise ValueError(f"shape {header.shape} of {header.dtype} in {member.file_size} bytes")

    @contextmanager
    def _damage_is_named(self, name: str = "") -> Iterator[None]:
        try:
            yield
        except (*_DAMAGE, OSError) as error:
            if isinstance(error, OSError) and error.errno != errno.EINVAL:  # EINVAL: a seek before the start
                raise
            place = f"{self._where}: {name}" if name else self._where
            found = f"cannot be read ({str(error)[:200] or type(error).__name__})"
            raise InputError(where=place, found=found, needed="an undamaged .npz file", fix=_FIX) from None


def read_arrays(data: bytes, where: str = "its arrays") -> dict[str, np.ndarray]:
    """Return the arrays that `numpy.savez` wrote; nothing is unpickled, and nothing expands beyond the file's size.

    Raises:
        InputError: It is another kind of file, damaged, compressed, or inconsistent.
    """
    file = NpzFile(io.BytesIO(data), where)
    headers = {name: file.header(name) for name in file.names}
    total = sum(prod(header.shape) * header.dtype.itemsize for header in headers.values())
    if total > len(data):
        found = f"arrays of {total:,} bytes in a file of {len(data):,}"
        raise InputError(where=where, found=found, needed="arrays that are not compressed")
    return {name: file.array(name).copy() for name in file.names}
