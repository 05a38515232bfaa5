"""Reading of strangers' .npz files: single arrays, or single frames of one. Nothing in them is ever unpickled."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from typing import IO, cast

import numpy as np
from jaxtyping import Shaped

from vjepa2_ac.errors import InputError, UserError
from vjepa2_ac.storage import ByteReader, is_refusal

_LOCAL_HEADER_BYTES = 30
_MOST_BYTES = 1 << 30  # of an array that is read completely
_MOST_UNPACKED, _MOST_RATIO = 1 << 30, 100  # a larger compressed array has at most this many times its packed bytes
_KINDS = frozenset({zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED})  # as numpy writes; others expand without a bound
_FIX = "Write the file again, with numpy.savez"


@dataclass(frozen=True)
class ArrayHeader:
    """Shape and type of an array, and where its values begin in the archive's member."""

    shape: tuple[int, ...]
    dtype: np.dtype
    start: int
    by_columns: bool = False  # in Fortran order, of more than one dimension

    @property
    def nbytes(self) -> int:
        """Size of the values."""
        return prod(self.shape) * self.dtype.itemsize

    @property
    def row_bytes(self) -> int:
        """Size of one row."""
        return prod(self.shape[1:]) * self.dtype.itemsize


class NpzFile:
    """An .npz file open for reading.

    Raises:
        InputError: It is not an .npz file; each method raises it for damage, too.
    """

    def __init__(self, file: ByteReader, where: str) -> None:
        self._file, self._where = file, where
        with self._damage_is_named():
            self._archive = zipfile.ZipFile(cast("IO[bytes]", file))
            members = [info for info in self._archive.infolist() if info.compress_type in _KINDS]
        self._members = {info.filename.removesuffix(".npy"): info for info in members if info.filename.endswith(".npy")}

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the arrays."""
        return tuple(self._members)

    def header(self, name: str) -> ArrayHeader:
        """Return shape and type of an array, without its values; it is refused if the file's size is another."""
        member = self._members[name]
        with self._damage_is_named(name), self._archive.open(member) as file:
            # Version 1.0 bounds the length of a header, and numpy writes another one only for records of many fields.
            if np.lib.format.read_magic(file) != (1, 0):
                raise ValueError("an array in another format than numpy writes")
            shape, by_columns, dtype = np.lib.format.read_array_header_1_0(file)
            header = ArrayHeader(shape, dtype, file.tell(), by_columns and len(shape) > 1)
            if dtype.hasobject:
                raise ValueError("an array of Python objects, which would have to be executed")
            if header.start + header.nbytes != member.file_size:
                raise ValueError(f"shape {header.shape} of {header.dtype} in {member.file_size} bytes")
            if member.file_size > max(_MOST_UNPACKED, _MOST_RATIO * member.compress_size):
                unpacked = f"{member.compress_size:,} bytes that unpack to {member.file_size:,}"
                raise ValueError(f"{unpacked}; above {_MOST_UNPACKED:,} bytes at most {_MOST_RATIO} times as many")
            return header

    def array(self, name: str) -> Shaped[np.ndarray, ...]:
        """Return a complete array; its checksum is verified."""
        header = self.header(name)
        with self._damage_is_named(name), self._archive.open(self._members[name]) as member:
            if header.nbytes > _MOST_BYTES:
                raise ValueError(f"shape {header.shape}, more than is ever read at once")
            values = np.frombuffer(member.read(), header.dtype, offset=header.start)
            return values.reshape(header.shape, order="F" if header.by_columns else "C")

    def rows(self, name: str, rows: Sequence[int]) -> Shaped[np.ndarray, "rows ..."]:
        """Return some rows of an array in C order, in this order.

        Of an uncompressed array only these rows are read, and the checksum is not verified: it covers the whole array.
        A compressed one is decompressed up to the last of these rows; other rows are not stored.
        """
        header, member = self.header(name), self._members[name]
        with self._damage_is_named(name), self._archive.open(member) as unpacked:
            stored = member.compress_type == zipfile.ZIP_STORED
            file, start = (self._file, self._start_of(member)) if stored else (unpacked, 0)
            ordered, places = np.unique(rows, return_inverse=True)
            found = np.empty((len(ordered), *header.shape[1:]), header.dtype)
            for place, row in enumerate(ordered.tolist()):
                file.seek(start + header.start + row * header.row_bytes)
                found[place] = np.frombuffer(file.read(header.row_bytes), header.dtype).reshape(header.shape[1:])
            return found if (places == np.arange(len(rows))).all() else found[places]

    def _start_of(self, member: zipfile.ZipInfo) -> int:
        """Return where the bytes of an uncompressed member begin in the file."""
        self._file.seek(member.header_offset)
        local = self._file.read(_LOCAL_HEADER_BYTES)
        names = int.from_bytes(local[26:28], "little") + int.from_bytes(local[28:30], "little")
        return member.header_offset + _LOCAL_HEADER_BYTES + names

    @contextmanager
    def _damage_is_named(self, name: str = "") -> Iterator[None]:
        try:
            yield
        except UserError:
            raise
        except Exception as error:  # zipfile, zlib and numpy raise whatever damage makes of a file
            if is_refusal(error):
                raise
            place = f"{self._where}: {name}" if name else self._where
            found = f"cannot be read ({str(error)[:200] or type(error).__name__})"
            raise InputError(where=place, found=found, needed="an undamaged .npz file", fix=_FIX) from None


def arrays_as_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return arrays as the content of a file that `read_arrays` reads; equal arrays give equal bytes."""
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type] # none is called allow_pickle
    return file.getvalue()


def read_arrays(data: bytes) -> dict[str, np.ndarray]:
    """Return the arrays that `numpy.savez` wrote; nothing is unpickled, and nothing expands beyond the file's size.

    Raises:
        InputError: It is another kind of file, damaged, compressed, or inconsistent.
    """
    file = NpzFile(io.BytesIO(data), "its arrays")
    if (total := sum(file.header(name).nbytes for name in file.names)) > len(data):
        found = f"arrays of {total:,} bytes in a file of {len(data):,}"
        raise InputError(where="its arrays", found=found, needed="arrays that are not compressed")
    return {name: file.array(name).copy() for name in file.names}
