"""Limits on decompressed Parquet data: equal values compress so well that a few KB may claim any memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from vjepa2_ac.errors import InputError

# All limits are far beyond any data set.
MOST_ROWS = 5_000_000  # of one row group, or of one episode
MOST_NUMBERS = 1 << 27  # of one column in a row group
MOST_TABLE_BYTES = 1 << 28  # of a table of episodes or tasks
MOST_IMAGE_BYTES = 1 << 32  # in one row group
FIX = "Copy the file again, or leave its episodes out"

_ROWS_AT_ONCE = 64  # where one value may be as large as an image


def parts_of(
    file: Any, path: str, columns: Sequence[str], most_bytes: int, **which: list[int]
) -> Iterator[dict[str, list[Any]]]:
    """Yield some columns a few rows at a time, as Python values, within a limit of their total size.

    Sizes are counted as Python values: the table stores equal ones once, Python a copy of each.

    Args:
        file: An open Parquet file.
        path: Its path, for messages.
        columns: Their names.
        most_bytes: Of all values.
        which: The row groups, if not all.

    Raises:
        InputError: They are larger.
    """
    total = 0
    for part in file.iter_batches(_ROWS_AT_ONCE, columns=list(columns), use_threads=False, **which):
        values = part.to_pydict()
        total += _bytes_in(values)
        if total > most_bytes:
            found = f"more than {most_bytes:,} bytes of {', '.join(columns)[:200]}"
            raise InputError(where=path, found=found, needed="a table that fits into memory", fix=FIX)
        yield values


def _bytes_in(value: Any) -> int:
    """Return the approximate size in bytes of nested lists and dicts of numbers, texts and images."""
    if isinstance(value, str | bytes):
        return len(value)
    if isinstance(value, dict):
        return sum(map(_bytes_in, value.values()))
    return sum(map(_bytes_in, value)) if isinstance(value, list) else 8


def require_few(file: Any, number: int, columns: Sequence[str], path: str) -> None:
    """Refuse a row group whose lists are longer than any robot's, before they are decompressed.

    Raises:
        InputError: They are.
    """
    group, schema = file.metadata.row_group(number), file.metadata.schema
    for place in range(group.num_columns):
        if not any(f"{schema.column(place).path}.".startswith(f"{name}.") for name in columns):  # or a part of one
            continue
        column = group.column(place)
        if column.num_values > MOST_NUMBERS:
            where, found = f"{path}: {column.path_in_schema}", f"{column.num_values:,} numbers in a row group"
            raise InputError(where=where, found=found, needed=f"at most {MOST_NUMBERS:,}", fix=FIX)


def require_sane(rows: Sequence[int], path: str, total: int | None = None) -> None:
    """Refuse implausible numbers of rows, or a total that differs from the sum of the row groups.

    Raises:
        InputError: There are such.
    """
    if any(not 0 <= count <= MOST_ROWS for count in rows) or (total is not None and sum(rows) != total):
        found = f"damaged: row groups of {list(rows[:5])} rows"
        raise InputError(where=path, found=found, needed="a whole Parquet file", fix=FIX)
