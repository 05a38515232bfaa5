"""The episode list of a LeRobot data set, with file locations. v3.0: Parquet tables. v2.1: lines of JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from vjepa2_ac import storage
from vjepa2_ac.data.index.state_hash import UNKNOWN, hash_of_bytes
from vjepa2_ac.data.sources.lerobot.info import DatasetInfo
from vjepa2_ac.data.sources.lerobot.parquet import Opener, read_table
from vjepa2_ac.data.sources.lerobot.path_templates import filled
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import json_object

EPISODES = {  # templates of the files that list the episodes
    "v2.1": "meta/episodes.jsonl",
    "v3.0": "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}

_T = TypeVar("_T")

_MOST_BYTES = 1 << 28  # of meta/episodes.jsonl
_FIX = "Get the files in meta again"
_STATISTICS = ("min", "max", "mean", "std")


@dataclass(frozen=True)
class VideoPlace:
    """The location of one camera's frames of an episode."""

    chunk: int
    file: int
    start_s: float  # of the episode's first frame
    length_s: float | None  # None: unknown


@dataclass(frozen=True)
class EpisodeRow:
    """The entry of one episode in the data set's tables."""

    index: int
    length: int
    tasks: tuple[str, ...]
    chunk: int  # of its rows
    file: int
    videos: Mapping[str, VideoPlace] = field(default_factory=dict)
    success: bool | None = None
    state_hash: int = UNKNOWN

    @property
    def id(self) -> str:
        """Its identity: its number, the only name in LeRobot."""
        return f"episode_{self.index:06d}"


@dataclass(frozen=True)
class StatisticsColumns:
    """Columns whose statistics in the tables are used."""

    states: tuple[str, ...]  # to find episodes with the same states; none: their rows are read
    success: str | None  # the episode's success


def read_episodes(
    info: DatasetInfo, tables: Sequence[str], keys: Sequence[str], wanted: StatisticsColumns, open_file: Opener
) -> list[EpisodeRow]:
    """Return every episode, sorted by number.

    Args:
        info: Of the data set.
        tables: The files that list the episodes, within the data set.
        keys: Videos whose locations are requested.
        wanted: Columns whose statistics are requested; v2.1 has none.
        open_file: Returns the path or file to open for a path.

    Raises:
        InputError: The tables are missing, damaged, or do not match the count in meta/info.json.
        OSError: A remote file cannot be read.
    """
    videos = [key for key in keys if info.features[key].dtype == "video"]
    if info.version == "v3.0":
        rows = [row for table in tables for row in _rows_of_table(info, table, videos, wanted, open_file)]
    else:
        rows = list(_rows_of_lines(info, videos))
    rows.sort(key=lambda row: row.index)
    numbers = [row.index for row in rows]
    if len(set(numbers)) != len(numbers) or len(rows) != info.episodes:
        where = storage.join(info.root, tables[0] if tables else "meta")
        found = f"{len(rows)} episodes, of {len(set(numbers))} numbers"
        needed = f"{info.episodes} of as many numbers, says {info.where}"
        raise InputError(where=where, found=found, needed=needed, fix=_FIX)
    return rows


def data_file(info: DatasetInfo, row: EpisodeRow) -> str:
    """Return the path, within the data set, of the file with an episode's rows."""
    return filled(info.data_path, row.chunk, row.file)


def video_file(info: DatasetInfo, place: VideoPlace, key: str) -> str:
    """Return the path, within the data set, of the file with an episode's frames."""
    return filled(info.video_path or "", place.chunk, place.file, key)


def _rows_of_lines(info: DatasetInfo, videos: Sequence[str]) -> Iterator[EpisodeRow]:
    where = storage.join(info.root, EPISODES["v2.1"])
    try:
        lines = storage.read_bounded(where, _MOST_BYTES).decode().splitlines()
    except FileNotFoundError:
        raise InputError(where=where, found="no such file", needed="one line for each episode", fix=_FIX) from None
    except UnicodeDecodeError as error:
        raise _damaged(where, error) from None
    for number, line in enumerate(lines):
        if not line.strip():
            continue
        with_line = f"{where}: line {number + 1}"
        row = json_object(line, where=with_line, needed="an episode", fix=_FIX)
        yield _checked(with_line, _episode_of_line, info, row, videos)


def _episode_of_line(info: DatasetInfo, row: Mapping[str, Any], videos: Sequence[str]) -> EpisodeRow:
    index = _count(row["episode_index"])
    chunk = index // info.chunk_episodes
    places = {key: VideoPlace(chunk, index, 0.0, None) for key in videos}
    return EpisodeRow(index, _count(row["length"]), _texts(row.get("tasks")), chunk, index, places)


def _rows_of_table(
    info: DatasetInfo, table: str, videos: Sequence[str], wanted: StatisticsColumns, open_file: Opener
) -> Iterator[EpisodeRow]:
    path = storage.join(info.root, table)
    outcome = f"stats/{wanted.success}/max"
    statistics = [f"stats/{name}/{kind}" for name in wanted.states for kind in _STATISTICS]
    prefixes = tuple(f"videos/{key}/" for key in videos)
    own = {"episode_index", "length", "tasks", "data/chunk_index", "data/file_index", outcome, *statistics}
    columns = read_table(open_file(path), path, lambda name: name in own or name.startswith(prefixes))
    lengths = {len(column) for column in columns.values()}
    if len(lengths) > 1:
        raise _damaged(path, f"columns of {sorted(lengths)} rows")
    for number in range(max(lengths, default=0)):
        row = {name: column[number] for name, column in columns.items()}
        yield _checked(f"{path}: row {number}", _episode_of_row, row, videos, row.get(outcome), statistics)


def _episode_of_row(
    row: Mapping[str, Any], videos: Sequence[str], outcome: object, statistics: Sequence[str]
) -> EpisodeRow:
    while isinstance(outcome, list) and outcome:
        outcome = outcome[0]
    return EpisodeRow(
        index=_count(row["episode_index"]),
        length=_count(row["length"]),
        tasks=_texts(row.get("tasks")),
        chunk=_count(row["data/chunk_index"]),
        file=_count(row["data/file_index"]),
        videos={key: _place(row, f"videos/{key}") for key in videos},
        success=bool(outcome) if isinstance(outcome, bool | int | float) else None,
        state_hash=_hash_of(row["length"], [row.get(name) for name in statistics]),
    )


def _hash_of(length: object, statistics: Sequence[object]) -> int:
    """Return a hash that represents an episode's states without reading its rows: of all their statistics."""
    if not statistics or any(one is None for one in statistics):
        return UNKNOWN
    return hash_of_bytes(json.dumps([length, *statistics], default=str).encode())


def _place(row: Mapping[str, Any], name: str) -> VideoPlace:
    start, end = float(row[f"{name}/from_timestamp"]), row.get(f"{name}/to_timestamp")
    if not math.isfinite(start) or start < 0:
        raise ValueError(f"{name}/from_timestamp {start}")
    length = None if end is None else float(end) - start
    return VideoPlace(_count(row[f"{name}/chunk_index"]), _count(row[f"{name}/file_index"]), start, length)


def _checked(where: str, read: Callable[..., _T], *arguments: object) -> _T:
    try:
        return read(*arguments)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise _damaged(where, error) from None


def _count(value: object) -> int:
    """Return a count; unlike for `int`, True, 1.5 and "1" are none."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value != int(value) or not 0 <= value < 2**31:
        raise ValueError(f"{value!r} is no count")
    return int(value)


def _texts(value: object) -> tuple[str, ...]:
    return tuple(map(str, value)) if isinstance(value, list) else () if value is None else (str(value),)


def _damaged(where: str, error: object) -> InputError:
    return InputError(where=where, found=f"not a list of episodes ({error!r})", needed="LeRobot's own", fix=_FIX)
