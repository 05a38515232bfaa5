"""The episodes of a LeRobot data set: read from its tables (v3.0: Parquet, v2.1: lines of JSON), kept as an index."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.data.index import UNKNOWN, EpisodeTable, Labels, hash_of_bytes
from vjepa2_ac.data.selection import as_problem
from vjepa2_ac.data.sources.lerobot.info import DatasetInfo, filled
from vjepa2_ac.data.sources.lerobot.parquet import Opener, read_table
from vjepa2_ac.episode import EpisodeInfo
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import zero_steps
from vjepa2_ac.storage.structured import json_object

TABLES = {  # templates of the files that list the episodes
    "v2.1": "meta/episodes.jsonl",
    "v3.0": "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}

_MOST_BYTES = 1 << 28  # of meta/episodes.jsonl
_FIX_TABLES = "Get the files in meta again"
_FIX = "Copy the data set again, or leave the episode out"
_STATISTICS = ("min", "max", "mean", "std")


@dataclass(frozen=True)
class VideoPlace:
    """The location of one camera's frames of an episode."""

    chunk: int
    file: int
    start_s: float  # of the episode's first frame
    length_s: float | None = None  # None: unknown


@dataclass(frozen=True)
class EpisodeRow:
    """The entry of one episode in the data set's tables."""

    index: int
    length: int
    chunk: int  # of its rows
    file: int
    tasks: tuple[str, ...] = ()
    videos: Mapping[str, VideoPlace] = field(default_factory=dict)
    success: bool | None = None
    state_hash: int = UNKNOWN

    @property
    def id(self) -> str:
        """Its identity: its number, the only name in LeRobot."""
        return f"episode_{self.index:06d}"


def data_file(info: DatasetInfo, row: EpisodeRow) -> str:
    """Return the path, within the data set, of the file with an episode's rows."""
    return filled(info.data_path, row.chunk, row.file)


def video_file(info: DatasetInfo, place: VideoPlace, key: str) -> str:
    """Return the path, within the data set, of the file with an episode's frames."""
    return filled(info.video_path or "", place.chunk, place.file, key)


def read_episodes(
    info: DatasetInfo,
    tables: Sequence[str],
    videos: Sequence[str],
    states: Sequence[str],
    success: str | None,
    open_file: Opener,
) -> list[EpisodeRow]:
    """Return every episode, sorted by number.

    Args:
        info: Of the data set.
        tables: The files that list the episodes, within the data set.
        videos: Features whose locations are requested.
        states: Columns whose statistics are to find episodes with the same states; v2.1 has none.
        success: Column whose statistics tell the outcome; likewise.
        open_file: Returns the path or file to open for a path.

    Raises:
        InputError: The tables are missing, damaged, or do not match the count in meta/info.json.
        OSError: A remote file cannot be read.
    """
    statistics = [f"stats/{name}/{kind}" for name in states for kind in _STATISTICS]
    outcome = f"stats/{success}/max"
    own = {"episode_index", "length", "tasks", "data/chunk_index", "data/file_index", outcome, *statistics}
    prefixes = tuple(f"videos/{key}/" for key in videos)
    rows = []
    for table in tables:
        path = storage.join(info.root, table)
        if info.version == "v2.1":
            values = list(_lines(path))
        else:
            columns = read_table(open_file(path), path, lambda name: name in own or name.startswith(prefixes))
            values = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        for number, row in enumerate(values):
            try:
                rows.append(_row_of(info, row, videos, row.get(outcome), statistics))
            except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
                found, needed = f"not an episode ({error!r})", "LeRobot's own tables"
                raise InputError(where=f"{path}: row {number}", found=found, needed=needed, fix=_FIX_TABLES) from None
    rows.sort(key=lambda row: row.index)
    numbers = {row.index for row in rows}
    if len(numbers) != len(rows) or len(rows) != info.episodes:
        where = storage.join(info.root, tables[0] if tables else "meta")
        found = f"{len(rows)} episodes, of {len(numbers)} numbers"
        needed = f"{info.episodes} of as many numbers, says {info.where}"
        raise InputError(where=where, found=found, needed=needed, fix=_FIX_TABLES)
    return rows


def _lines(path: str) -> Iterator[dict[str, Any]]:
    """Yield what each line of meta/episodes.jsonl says."""
    for number, line in enumerate(storage.read_bounded(path, _MOST_BYTES).splitlines(), start=1):
        if line.strip():
            where = f"{path}: line {number}"
            yield json_object(line, where=where, needed="an episode", fix=_FIX_TABLES)


def _row_of(
    info: DatasetInfo, row: Mapping[str, Any], videos: Sequence[str], outcome: object, statistics: Sequence[str]
) -> EpisodeRow:
    index = int(row["episode_index"])
    if info.version == "v2.1":  # a file for each episode
        places = ("data", *(f"videos/{key}" for key in videos))
        row = {**row, **{f"{place}/chunk_index": index // info.chunk_episodes for place in places}}
        row |= {f"{place}/file_index": index for place in places} | {f"{place}/from_timestamp": 0 for place in places}
    while isinstance(outcome, list) and outcome:
        outcome = outcome[0]
    of_states = [row.get(name) for name in statistics]
    is_known = bool(of_states) and None not in of_states
    hashed = json.dumps([row["length"], *of_states], default=str).encode()
    tasks = row.get("tasks") or ()
    return EpisodeRow(
        index=index,
        length=int(row["length"]),
        chunk=int(row["data/chunk_index"]),
        file=int(row["data/file_index"]),
        tasks=tuple(map(str, tasks)) if isinstance(tasks, list | tuple) else (str(tasks),),
        videos={key: _place(row, f"videos/{key}") for key in videos},
        success=bool(outcome) if isinstance(outcome, bool | int | float) else None,
        state_hash=hash_of_bytes(hashed) if is_known else UNKNOWN,
    )


def _place(row: Mapping[str, Any], name: str) -> VideoPlace:
    start, end = float(row[f"{name}/from_timestamp"]), row.get(f"{name}/to_timestamp")
    if not math.isfinite(start) or start < 0:
        raise ValueError(f"{name}/from_timestamp {start}")
    length = None if end is None else float(end) - start
    return VideoPlace(int(row[f"{name}/chunk_index"]), int(row[f"{name}/file_index"]), start, length)


def problem_of(info: DatasetInfo, row: EpisodeRow, files: Set[str], keys: Sequence[str]) -> InputError | None:
    """Return the problem of an episode that the data set's tables show, or None.

    Args:
        info: Of the data set.
        row: The episode.
        files: The existing files, within the data set.
        keys: Features of the cameras that are used.
    """
    if row.length == 0:
        return zero_steps(f"{info.root}: {row.id}")
    rows_in = data_file(info, row)
    if rows_in not in files:
        where, needed = f"{storage.join(info.root, rows_in)}: {row.id}", f"the {row.length} rows of the episode"
        return InputError(where=where, found="no such file", needed=needed, fix=_FIX)
    for key in keys:
        if (place := row.videos.get(key)) is None:
            continue
        shown_in = video_file(info, place, key)
        where, of_rows = f"{storage.join(info.root, shown_in)}: {row.id}", f"for {row.length} rows in {rows_in}"
        if shown_in not in files:
            return InputError(where=where, found=f"no such video, {of_rows}", needed=f"the frames of {key}", fix=_FIX)
        if place.length_s is not None and not place.length_s > (row.length - 0.5) / info.fps:
            found = f"{place.length_s:.3f} s of video, says the data set, {of_rows}"
            needed = f"{row.length / info.fps:.3f} s"
            return InputError(where=where, found=found, needed=needed, fix="Leave the episode out")
    return None


def table_of(rows: Sequence[EpisodeRow], problems: Mapping[int, InputError], texts: Mapping[str, str]) -> EpisodeTable:
    """Return the usable episodes as a table, and the problems of the others, given by their numbers.

    Raises:
        InputError: No episode can be used: the first one's error.
    """
    usable = [row for row in rows if row.index not in problems]
    if not usable and problems:
        raise problems[min(problems)]
    task_of = ["; ".join(row.tasks) for row in usable]
    tasks = sorted(set(task_of))
    numbers: dict[str, list[int]] = {
        "index": [row.index for row in usable],
        "chunk": [row.chunk for row in usable],
        "file": [row.file for row in usable],
        "task": [tasks.index(task) for task in task_of],
    }
    locators = {name: np.array(values, np.int64) for name, values in numbers.items()}
    for key in usable[0].videos if usable else ():
        places = [row.videos[key] for row in usable]
        locators[f"{key}.chunk"] = np.array([place.chunk for place in places], np.int32)
        locators[f"{key}.file"] = np.array([place.file for place in places], np.int32)
        locators[f"{key}.start_s"] = np.array([place.start_s for place in places], np.float64)
    labels, hashes = Labels.of(task_of), [row.state_hash for row in usable]
    return EpisodeTable.of(
        [EpisodeInfo(row.id, row.length, row.success) for row in usable],
        problems=[as_problem(problems[row.index], row.id) for row in rows if row.index in problems],
        locators=locators,
        texts={"tasks": json.dumps(tasks), **texts},
        state_hashes=hashes if any(hashes) else None,
        labels={"task": labels} if labels.names else {},
    )


def row_of(table: EpisodeTable, place: int) -> EpisodeRow:
    """Return the location of an episode of a table; its tasks stay in the table."""
    at = {name: column[place].item() for name, column in table.locators.items()}
    keys = [name.removesuffix(".start_s") for name in at if name.endswith(".start_s")]
    videos = {key: VideoPlace(at[f"{key}.chunk"], at[f"{key}.file"], at[f"{key}.start_s"]) for key in keys}
    return EpisodeRow(at["index"], int(table.num_steps[place]), at["chunk"], at["file"], videos=videos)
