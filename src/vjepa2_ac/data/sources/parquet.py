"""Read the rows of one episode from a Parquet file of many episodes: only its row groups and the required columns.

An untrusted file cannot exhaust the memory. A few KB of compressed equal values may expand to any size, so the footer's
numbers of values are checked first, and tables of text or images are read a few rows at a time.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Shaped

from vjepa2_ac import storage
from vjepa2_ac.data.files import EpisodeFiles
from vjepa2_ac.errors import InputError, counted, require_library
from vjepa2_ac.storage.block_file import BlockCachedFile

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow import parquet

Columns = Mapping[str, Shaped[np.ndarray, "rows _"]]

EPISODE_COLUMN = "episode_index"

# All limits are far beyond any real data set.
MAX_NUMBERS = 1 << 25  # numbers in one column of a row group
MAX_TABLE_BYTES = 1 << 28  # size of a table of episodes or tasks
MAX_IMAGE_BYTES = 1 << 32  # size of the images in one row group
_ROWS_AT_ONCE = 64  # rows per read if a value may be as large as an image
_BUFFER_BYTES = 4096  # buffer of a column whose values are not read
_FIX = "Copy the file again, or exclude its episodes"


class ParquetRows:
    """A reader of rows of Parquet files; each thread keeps the row group that it decoded last.

    Args:
        files: Opens files, and caches the rows of each episode, so that a row group of hundreds of episodes is not
            decoded for each of them.
        columns: The columns to read if a file has them; the index of the episode is always read.
        version: Version of the cached rows; changes with the data set or the columns.
    """

    def __init__(self, files: EpisodeFiles, columns: Sequence[str], version: str) -> None:
        self._files, self._version = files, version
        self._columns = list(dict.fromkeys([EPISODE_COLUMN, *columns]))
        self._ranges: dict[str, list[tuple[float, float]]] = {}  # of each row group, by file
        self._last = threading.local()

    def read_rows(self, path: str, episode: int) -> Columns:
        """Return the rows of one episode, as columns of shape [rows, numbers].

        Raises:
            InputError: The file is missing or damaged, or a column does not contain numbers.
            OSError: A remote file cannot be read.
        """

        def read() -> Columns:
            parts: list[Columns] = []
            with self._open_groups(path, episode) as (file, groups):
                for number in groups:
                    group = self._read_group(path, file, number)
                    is_in_episode = group[EPISODE_COLUMN][:, 0] == episode
                    parts.append({name: column[is_in_episode] for name, column in group.items()})
            return {name: np.concatenate([part[name] for part in parts]) for name in (parts[0] if parts else ())}

        return self._files.read_parsed(f"rows {self._version} {path} {episode}", read)

    def read_images(self, path: str, column: str, episode: int) -> list[bytes]:
        """Read the encoded images of one episode from a column of {bytes, path}.

        Raises:
            InputError: The file is missing or damaged, or the column does not contain images.
            OSError: A remote file cannot be read.
        """
        images: list[Any] = []
        with self._open_groups(path, episode) as (file, groups):
            for number in groups:
                for part in _read_parts(file, path, [EPISODE_COLUMN, column], MAX_IMAGE_BYTES, row_groups=[number]):
                    rows = zip(part[column], part[EPISODE_COLUMN], strict=True)
                    selected = [row for row, row_episode in rows if row_episode == episode]
                    images += [row.get("bytes") if isinstance(row, dict) else row for row in selected]
        if not all(isinstance(image, bytes) for image in images):
            raise InputError(
                where=f"{path}: {column}",
                found="values that are not encoded images, such as file names",
                needed="PNG or JPEG bytes in the column",
            )
        return images

    @contextmanager
    def _open_groups(self, path: str, episode: int) -> Iterator[tuple[parquet.ParquetFile, list[int]]]:
        """Open a file; yield it and the row groups that may have rows of an episode, by its statistics."""
        source = self._files.open(path, version=self._version)
        with _open_parquet(source, path) as file:
            if path not in self._ranges:
                self._ranges[path] = _read_episode_ranges(file, path, source, self._columns)
            yield file, [n for n, (first, last) in enumerate(self._ranges[path]) if first <= episode <= last]

    def _read_group(self, path: str, file: parquet.ParquetFile, number: int) -> Columns:
        if getattr(self._last, "path_and_group", None) != (path, number):
            present = [name for name in self._columns if name in file.schema_arrow.names]
            table = file.read_row_group(number, columns=present, use_threads=False)
            self._last.group = {name: to_numbers(table.column(name), f"{path}: {name}") for name in present}
            self._last.path_and_group = path, number
        group: Columns = self._last.group
        return group


def read_table(source: str | BlockCachedFile, path: str, is_selected: Callable[[str], bool]) -> dict[str, list[Any]]:
    """Read selected columns of a small Parquet file as lists of Python values.

    Raises:
        InputError: The file is missing or damaged.
        OSError: A remote file cannot be read.
    """
    with _open_parquet(source, path) as file:
        present = [name for name in file.schema_arrow.names if is_selected(name)]
        values: dict[str, list[Any]] = {name: [] for name in present}
        for part in _read_parts(file, path, present, MAX_TABLE_BYTES):
            for name in part:
                values[name] += part[name]
        return values


def to_numbers(column: pa.ChunkedArray, where: str) -> Shaped[np.ndarray, "rows _"]:
    """Convert a column of numbers, or of lists of equal length, to an array [rows, numbers].

    Raises:
        InputError: The column has other content or missing values.
    """
    import pyarrow as pa

    array = column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)
    rows, width = len(array), 1
    while isinstance(array, pa.ExtensionArray):
        array = array.storage
    while pa.types.is_nested(array.type):
        if array.null_count or not hasattr(array, "value_lengths"):
            raise _not_numeric_error(where, str(column.type), array.null_count)
        lengths = np.unique(array.value_lengths().to_numpy(zero_copy_only=False))
        if len(lengths) > 1:
            problem = f"{lengths[0]} numbers in one row and {lengths[-1]} in another row"
            raise InputError(where=where, found=problem, needed="the same count of numbers in each row")
        width *= int(lengths[0]) if len(lengths) else 0
        array = array.flatten()
    kind = array.type
    if array.null_count or not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)):
        raise _not_numeric_error(where, str(column.type), array.null_count)
    return np.asarray(array.to_numpy(zero_copy_only=False)).reshape(rows, width)


def _not_numeric_error(where: str, kind: str, num_nulls: int) -> InputError:
    problem = f"{counted(num_nulls, 'row')} without a value" if num_nulls else f"values of type {kind}"
    return InputError(where=where, found=problem, needed="the same count of numbers in each row", fix=_FIX)


@contextmanager
def _open_parquet(source: str | BlockCachedFile, path: str) -> Iterator[parquet.ParquetFile]:
    """Open a Parquet file with verified page checksums, and convert its errors to errors for the user."""
    pa = import_pyarrow(path)
    try:
        with pa.parquet.ParquetFile(
            source, page_checksum_verification=True, pre_buffer=not isinstance(source, str), memory_map=False
        ) as file:
            yield file
    except (pa.ArrowException, OSError, ValueError, KeyError, MemoryError, OverflowError) as error:
        if isinstance(source, BlockCachedFile) and source.failure is not None:
            raise source.failure from None
        if isinstance(error, OSError) and error.errno is not None:  # an error of the operating system
            raise storage.read_error(path, error, fix=_FIX) from None
        problem = f"the file is damaged: {' '.join(str(error).strip().splitlines()[:1])[:200]}"
        raise InputError(where=path, found=problem, needed="a complete Parquet file", fix=_FIX) from None


def _read_episode_ranges(
    file: parquet.ParquetFile, path: str, source: str | BlockCachedFile, columns: Sequence[str]
) -> list[tuple[float, float]]:
    """Return the smallest and the largest episode number of each row group; infinite without statistics in the file.

    Raises:
        InputError: There is no column of episode numbers, or a column has too many numbers.
        pyarrow.ArrowException, OSError: The entries of the footer are inconsistent.
    """
    paths = [file.metadata.schema.column(index).path for index in range(file.metadata.num_columns)]
    indices = [index for index, path in enumerate(paths) if any(f"{path}.".startswith(f"{name}.") for name in columns)]
    _require_consistent(file, source, indices)
    if EPISODE_COLUMN not in paths:
        raise InputError(where=path, found=f"the column {EPISODE_COLUMN} is missing", fix=_FIX)
    ranges: list[tuple[float, float]] = []
    for number in range(file.num_row_groups):
        group = file.metadata.row_group(number)
        for index in indices:
            if (count := group.column(index).num_values) > MAX_NUMBERS:
                problem, needed = f"{count:,} numbers in a row group", f"at most {MAX_NUMBERS:,}"
                raise InputError(where=f"{path}: {paths[index]}", found=problem, needed=needed, fix=_FIX)
        statistics = group.column(paths.index(EPISODE_COLUMN)).statistics
        has_range = statistics is not None and statistics.has_min_max and isinstance(statistics.min, int)
        ranges.append((statistics.min, statistics.max) if has_range else (-inf, inf))
    return ranges


def _require_consistent(file: parquet.ParquetFile, source: str | BlockCachedFile, indices: list[int]) -> None:
    """Refuse a file whose footer has inconsistent entries of some columns, in any row group.

    Reading such an entry with pyarrow (`row_group(n).column(p)`) aborts the process with an unhandled C++ exception.
    Reading one row makes the same checks and raises a Python error. For a remote file no row is read, which finds fewer
    errors, because the blocks of every row group would be fetched.
    """
    parquet = import_pyarrow(str(source)).parquet
    rows = 1 if isinstance(source, str) else 0
    with parquet.ParquetFile(
        source, metadata=file.metadata, buffer_size=_BUFFER_BYTES, pre_buffer=False
    ) as footer_check:
        for group in range(file.num_row_groups):
            next(
                footer_check.reader.iter_batches(rows, row_groups=[group], column_indices=indices, use_threads=False),
                None,
            )


def _read_parts(
    file: parquet.ParquetFile, path: str, columns: list[str], max_bytes: int, **selection: list[int]
) -> Iterator[dict[str, list[Any]]]:
    """Yield some columns as Python values, a few rows at a time, up to a limit of their total size.

    Sizes are counted as Python values, because Python stores every value, but the table stores equal values only once.
    """
    total = 0
    for part in file.iter_batches(_ROWS_AT_ONCE, columns=columns, use_threads=False, **selection):
        values = part.to_pydict()
        total += _estimate_bytes(values)
        if total > max_bytes:
            problem = f"more than {max_bytes:,} bytes of {', '.join(columns)[:200]}"
            raise InputError(where=path, found=problem, needed="a table that fits into memory", fix=_FIX)
        yield values


def _estimate_bytes(value: Any) -> int:
    """Return the approximate size in bytes of nested lists and dicts of numbers, texts and images."""
    if isinstance(value, str | bytes):
        return len(value)
    if isinstance(value, dict):
        return sum(map(_estimate_bytes, value.values()))
    return sum(map(_estimate_bytes, value)) if isinstance(value, list) else 8


def import_pyarrow(where: str) -> Any:
    """Import and return pyarrow, with its module `parquet`."""
    called = "pyarrow, which reads and writes LeRobot data sets"
    require_library("pyarrow.parquet", where=where, called=called, extra="lerobot")
    return require_library("pyarrow", where=where, called=called, extra="lerobot")
