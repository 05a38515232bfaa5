"""Reading the rows of one episode from a Parquet file of many: only its row groups, and the needed columns."""

from __future__ import annotations

import io
import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Shaped

from vjepa2_ac import storage
from vjepa2_ac.data.sources.lerobot.bounds import (
    FIX,
    MOST_IMAGE_BYTES,
    MOST_TABLE_BYTES,
    parts_of,
    require_few,
    require_sane,
)
from vjepa2_ac.errors import InputError, require_library
from vjepa2_ac.storage.block_file import BlockCachedFile, DiskCache
from vjepa2_ac.storage.npz_reader import read_arrays

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow import parquet

Columns = Mapping[str, Shaped[np.ndarray, "rows _"]]
Opener = Callable[[str], "str | BlockCachedFile"]  # a path, or a remote file

EPISODE = "episode_index"

_CACHED_BYTES = 64 << 20  # of decoded row groups, in a process
_BUFFER_BYTES = 4096  # of a column that is not read
_CACHED_FOOTERS = 256


class ParquetRows:
    """Reads rows of Parquet files; decoded row groups, and which episodes are in which, are cached. Thread-safe.

    Args:
        open_file: Returns the path or file to open for a path.
        columns: The wanted ones, if a file has them; the index of the episode is always read.
        cache: On this machine's disk, of rows that share their row group with other episodes: so that a row group of
            hundreds of episodes is not decoded for each of them.
        version: Of the cached rows: changes with the data set or the wanted columns.
    """

    def __init__(
        self, open_file: Opener, columns: Sequence[str], cache: DiskCache | None = None, version: str = ""
    ) -> None:
        self._cache, self._version = cache, version
        self._open, self._columns = open_file, list(dict.fromkeys([EPISODE, *columns]))
        self._lock = threading.Lock()
        self._ranges: OrderedDict[str, list[tuple[float, float]]] = OrderedDict()
        self._groups: OrderedDict[tuple[str, int], Columns] = OrderedDict()

    def rows(self, path: str, episode: int) -> Columns:
        """Return the rows of one episode, as columns of shape [rows, numbers].

        Raises:
            InputError: The file is missing or damaged, or a column does not contain numbers.
            OSError: A remote file cannot be read.
        """
        key = f"rows {self._version} {path} {episode}"
        if (known := self._cached(key)) is not None:
            return known
        parts, shared = [], False
        opened = self._open(path)
        with _opened(opened, path) as file:
            for number in self._groups_with(path, file, opened, episode):
                group = self._group(path, file, number)
                chosen = _places_of(group, episode)
                parts.append({name: column[chosen] for name, column in group.items()})
                shared |= len(parts[-1][EPISODE]) < len(group[EPISODE])
                require_sane([sum(len(part[EPISODE]) for part in parts)], path)
        rows = {name: np.concatenate([part[name] for part in parts]) for name in (parts[0] if parts else ())}
        if self._cache is not None and shared:
            content = io.BytesIO()
            np.savez(content, **rows)  # type: ignore[arg-type] # names are columns, none is called allow_pickle
            self._cache.write(key, content.getvalue())
        return rows

    def images(self, path: str, column: str, episode: int) -> list[bytes]:
        """Return the encoded images of one episode from a column of {bytes, path}.

        Raises:
            InputError: The file is missing or damaged, or the column does not contain images.
            OSError: A remote file cannot be read.
        """
        found: list[bytes] = []
        opened = self._open(path)
        with _opened(opened, path) as file:
            for number in self._groups_with(path, file, opened, episode):
                for part in parts_of(file, path, [EPISODE, column], MOST_IMAGE_BYTES, row_groups=[number]):
                    found += _images_in(part[column], part[EPISODE], episode, f"{path}: {column}")
        return found

    def _cached(self, key: str) -> Columns | None:
        data = None if self._cache is None else self._cache.read(key)
        with suppress(InputError):  # damaged: read again
            return None if data is None else read_arrays(data)
        return None

    def _groups_with(
        self, path: str, file: parquet.ParquetFile, opened: str | BlockCachedFile, episode: int
    ) -> list[int]:
        """Return the row groups that may have rows of an episode, as far as the file's statistics say."""
        with self._lock:
            ranges = self._ranges.get(path)
        if ranges is None:
            _require_consistent(file, opened, self._columns)
            ranges = _episodes_of_groups(file, path)
            with self._lock:
                self._ranges[path] = ranges
                if len(self._ranges) > _CACHED_FOOTERS:
                    self._ranges.popitem(last=False)
        return [number for number, (first, last) in enumerate(ranges) if first <= episode <= last]

    def _group(self, path: str, file: parquet.ParquetFile, number: int) -> Columns:
        with self._lock:
            if (path, number) in self._groups:
                self._groups.move_to_end((path, number))
                return self._groups[path, number]
        present = [name for name in self._columns if name in file.schema_arrow.names]
        require_few(file, number, present, path)
        table = file.read_row_group(number, columns=present, use_threads=False)
        group = {name: numbers_in(table.column(name), f"{path}: {name}") for name in present}
        if EPISODE not in group:
            raise InputError(where=path, found=f"no column {EPISODE}", needed="one", fix=FIX)
        with self._lock:
            self._groups[path, number] = group
            sizes = [sum(column.nbytes for column in columns.values()) for columns in self._groups.values()]
            while len(sizes) > 1 and sum(sizes) > _CACHED_BYTES:
                sizes.pop(0)
                self._groups.popitem(last=False)
        return group


def read_table(opened: str | BlockCachedFile, path: str, wanted: Callable[[str], bool]) -> dict[str, list[Any]]:
    """Return the wanted columns of a small Parquet file, as lists of Python values.

    Raises:
        InputError: It is missing or damaged.
        OSError: A remote file cannot be read.
    """
    with _opened(opened, path) as file:
        _require_sane_groups(file, path)
        present = [name for name in file.schema_arrow.names if wanted(name)]
        values: dict[str, list[Any]] = {name: [] for name in present}
        for part in parts_of(file, path, present, MOST_TABLE_BYTES):
            for name in part:
                values[name] += part[name]
        return values


def numbers_in(column: pa.ChunkedArray, where: str) -> Shaped[np.ndarray, "rows _"]:
    """Return a column of numbers, or of lists of equally many numbers, as [rows, numbers].

    Raises:
        InputError: It contains something else, or gaps.
    """
    import pyarrow as pa

    array = column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)
    rows, width = len(array), 1
    while isinstance(array, pa.ExtensionArray):
        array = array.storage
    while pa.types.is_nested(array.type):
        if array.null_count or not hasattr(array, "value_lengths"):
            raise _no_numbers(where, str(column.type), array.null_count)
        lengths = np.unique(array.value_lengths().to_numpy(zero_copy_only=False))
        if len(lengths) > 1:
            found = f"{lengths[0]} numbers in one row and {lengths[-1]} in another"
            raise InputError(where=where, found=found, needed="as many")
        width *= int(lengths[0]) if len(lengths) else 0
        array = array.flatten()
    kind = array.type
    if array.null_count or not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)):
        raise _no_numbers(where, str(column.type), array.null_count)
    return np.asarray(array.to_numpy(zero_copy_only=False)).reshape(rows, width)


@contextmanager
def _opened(opened: str | BlockCachedFile, path: str) -> Iterator[parquet.ParquetFile]:
    """Open a Parquet file with verified page checksums; its errors become errors for the user."""
    pa, parquet = _library(path)
    try:
        with parquet.ParquetFile(
            opened, page_checksum_verification=True, pre_buffer=not isinstance(opened, str), memory_map=False
        ) as file:
            yield file
    except FileNotFoundError:
        raise InputError(where=path, found="no such file", needed="one, says the data set", fix=FIX) from None
    except (pa.ArrowException, OSError, ValueError, KeyError, MemoryError, OverflowError) as error:
        if isinstance(opened, BlockCachedFile) and opened.failure is not None:
            raise opened.failure from None
        if isinstance(error, OSError) and error.errno is not None:  # a system error, not one of the content
            raise storage.unreadable(path, error, fix=FIX) from None
        found = f"damaged: {' '.join(str(error).strip().splitlines()[:1])[:200]}"
        raise InputError(where=path, found=found, needed="a whole Parquet file", fix=FIX) from None


def _places_of(group: Columns, episode: int) -> slice | Shaped[np.ndarray, " rows"]:
    """Return the rows of an episode in a row group: as a slice if they are contiguous, as they should be."""
    places = np.flatnonzero(group[EPISODE][:, 0] == episode)
    together = len(places) > 0 and places[-1] - places[0] == len(places) - 1
    return slice(int(places[0]), int(places[-1]) + 1) if together else places


def _episodes_of_groups(file: parquet.ParquetFile, path: str) -> list[tuple[float, float]]:
    """Return the least and the greatest episode of each row group; infinite ones if the file does not say."""
    _require_sane_groups(file, path)
    metadata = file.metadata
    if EPISODE not in file.schema_arrow.names:
        raise InputError(where=path, found=f"no column {EPISODE}", needed="one", fix=FIX)
    place = [metadata.schema.column(number).path for number in range(metadata.num_columns)].index(EPISODE)
    ranges: list[tuple[float, float]] = []
    for number in range(metadata.num_row_groups):
        statistics = metadata.row_group(number).column(place).statistics
        known = statistics is not None and statistics.has_min_max and isinstance(statistics.min, int)
        ranges.append((statistics.min, statistics.max) if known else (-math.inf, math.inf))
    return ranges


def _require_consistent(file: parquet.ParquetFile, opened: str | BlockCachedFile, columns: Sequence[str]) -> None:
    """Refuse an inconsistent footer entry of some columns, in any row group.

    Reading such an entry with pyarrow (`row_group(n).column(p)`) ends the process: a C++ exception that its binding
    does not expect. A reader of no rows makes the same checks, reads nothing, and raises.

    Raises:
        pyarrow.ArrowException, OSError: It is damaged.
    """
    _, parquet = _library(str(opened))
    paths = [file.metadata.schema.column(number).path + "." for number in range(file.metadata.num_columns)]
    places = [number for number, path in enumerate(paths) if any(path.startswith(f"{name}.") for name in columns)]
    with parquet.ParquetFile(opened, metadata=file.metadata, buffer_size=_BUFFER_BYTES, pre_buffer=False) as light:
        for group in range(file.metadata.num_row_groups):
            next(light.reader.iter_batches(0, row_groups=[group], column_indices=places, use_threads=False), None)


def _require_sane_groups(file: parquet.ParquetFile, path: str) -> None:
    metadata = file.metadata
    require_sane([metadata.row_group(n).num_rows for n in range(metadata.num_row_groups)], path, metadata.num_rows)


def _images_in(rows: list[Any], episodes: list[Any], episode: int, where: str) -> list[bytes]:
    chosen = [row for row, its in zip(rows, episodes, strict=True) if its == episode]
    stored = [row.get("bytes") if isinstance(row, dict) else row for row in chosen]
    images = [image for image in stored if isinstance(image, bytes)]
    if len(images) != len(stored):
        found, needed = "no images, or names of files in their place", "PNG or JPEG bytes in the column"
        raise InputError(where=where, found=found, needed=needed)
    return images


def _no_numbers(where: str, kind: str, gaps: int) -> InputError:
    found = f"{gaps} rows without a value" if gaps else f"values of type {kind}"
    return InputError(where=where, found=found, needed="numbers, as many in each row", fix=FIX)


def _library(where: str) -> tuple[Any, Any]:
    called = "pyarrow, which reads LeRobot data sets"
    pa = require_library("pyarrow", where=where, called=called, extra="lerobot")
    return pa, require_library("pyarrow.parquet", where=where, called=called, extra="lerobot")
