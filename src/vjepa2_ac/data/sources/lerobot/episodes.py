"""The episodes of a LeRobot data set: read from its tables (v3.0: Parquet, v2.1: lines of JSON), kept as an index."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

from vjepa2_ac import storage
from vjepa2_ac.data.index import UNKNOWN, EpisodeTable, hash_of_bytes
from vjepa2_ac.data.sources.lerobot.info import DatasetInfo, filled
from vjepa2_ac.data.sources.lerobot.parquet import read_table
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.media.video import VideoHeader
from vjepa2_ac.spaces import zero_steps
from vjepa2_ac.storage.block_file import BlockCachedFile
from vjepa2_ac.storage.structured import json_object

TABLES = {  # templates of the files that list the episodes
    "v2.1": "meta/episodes.jsonl",
    "v3.0": "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}

_MOST_BYTES = 1 << 28  # of meta/episodes.jsonl
_FIX_TABLES = "Get the files in meta again"
_FIX = "Copy the data set again, or leave the episode out"
_FIX_RANGES = (
    "Correct file_index, from_timestamp and to_timestamp in meta/episodes (they may be wrong for other episodes of the "
    "file, too), or leave both episodes out"
)
_STATISTICS = ("min", "max", "mean", "std")
_ROUNDING_STEPS = 0.25  # by which the ranges of two episodes in a video may overlap


@dataclass(frozen=True)
class EpisodeRow:
    """The entry of one episode in the data set's tables."""

    length: int
    place: Mapping[str, float]  # index; chunk and file of its rows; KEY.chunk, KEY.file and KEY.start_s of each video
    task: str = ""
    lengths_s: Mapping[str, float] = field(default_factory=dict)  # of its part of each video, where the table says it
    success: bool | None = None
    state_hash: int = UNKNOWN

    @property
    def index(self) -> int:
        """Its number."""
        return int(self.place["index"])

    @property
    def id(self) -> str:
        """Its identity: its number, the only name in LeRobot."""
        return f"episode_{self.index:06d}"

    def data_file(self, info: DatasetInfo) -> str:
        """Return the path, within the data set, of the file with its rows."""
        return filled(info.data_path, int(self.place["chunk"]), int(self.place["file"]))

    def video_file(self, info: DatasetInfo, key: str) -> str:
        """Return the path, within the data set, of the file with its frames."""
        chunk, file = (int(self.place[f"{key}.{part}"]) for part in ("chunk", "file"))
        return filled(info.video_path or "", chunk, file, key)


def read_episodes(
    info: DatasetInfo,
    tables: Sequence[str],
    videos: Sequence[str],
    states: Sequence[str],
    success: str | None,
    open_file: Callable[[str], str | BlockCachedFile],
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
        found = f"{counted(len(rows), 'episode')}, of {len(numbers)} numbers"
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
    place: dict[str, float] = {
        "index": index,
        "chunk": int(row["data/chunk_index"]),
        "file": int(row["data/file_index"]),
    }
    lengths_s = {}
    for key in videos:
        name = f"videos/{key}"
        start, end = float(row[f"{name}/from_timestamp"]), row.get(f"{name}/to_timestamp")
        if not math.isfinite(start) or start < 0:
            raise ValueError(f"{name}/from_timestamp {start}")
        place |= {f"{key}.{part}": int(row[f"{name}/{part}_index"]) for part in ("chunk", "file")}
        place[f"{key}.start_s"] = start
        if end is not None:
            lengths_s[key] = float(end) - start
    return EpisodeRow(
        length=int(row["length"]),
        place=place,
        task="; ".join(map(str, tasks)) if isinstance(tasks, list | tuple) else str(tasks),
        lengths_s=lengths_s,
        success=bool(outcome) if isinstance(outcome, bool | int | float) else None,
        state_hash=hash_of_bytes(hashed) if is_known else UNKNOWN,
    )


def require_files(info: DatasetInfo, row: EpisodeRow, files: Set[str], keys: Sequence[str]) -> None:
    """Refuse an episode that cannot be used, as far as the data set's tables show.

    Args:
        info: Of the data set.
        row: The episode.
        files: The existing files, within the data set.
        keys: Features of the cameras that are used.

    Raises:
        InputError: It has no steps; or its rows or frames are missing, or too few.
    """
    if row.length == 0:
        raise zero_steps(f"{info.root}: {row.id}")
    rows_in = row.data_file(info)
    if rows_in not in files:
        where, needed = f"{storage.join(info.root, rows_in)}: {row.id}", f"the {row.length} rows of the episode"
        raise InputError(where=where, found="no such file", needed=needed, fix=_FIX)
    for key in keys:
        if f"{key}.file" not in row.place:
            continue
        shown_in = row.video_file(info, key)
        where, of_rows = f"{storage.join(info.root, shown_in)}: {row.id}", f"for {row.length} rows in {rows_in}"
        if shown_in not in files:
            raise InputError(where=where, found=f"no such video, {of_rows}", needed=f"the frames of {key}", fix=_FIX)
        if not row.lengths_s.get(key, math.inf) > (row.length - 0.5) / info.fps:
            found = f"{row.lengths_s[key]:.3f} s of video, says the data set, {of_rows}"
            needed = f"{row.length / info.fps:.3f} s"
            raise InputError(where=where, found=found, needed=needed, fix="Leave the episode out")


def require_long_videos(
    info: DatasetInfo, row: EpisodeRow, keys: Sequence[str], header_of: Callable[[str], VideoHeader]
) -> None:
    """Refuse an episode whose video ends before its last step, as far as the header of the video shows.

    Args:
        info: Of the data set.
        row: The episode.
        keys: Features of the cameras that are used.
        header_of: Returns the header of a video, given by its path.

    Raises:
        InputError: A video is too short, or cannot be read.
    """
    for key in keys:
        if f"{key}.file" in row.place:
            path = storage.join(info.root, row.video_file(info, key))
            header, last_s = header_of(path), row.place[f"{key}.start_s"] + (row.length - 1) / info.fps
            if header.num_frames < row.length or header.span_s < last_s - 0.5 / info.fps:
                found = f"{header.num_frames} frames at {header.rate_hz:.4g} a second, up to {header.span_s:.3f} s"
                needed = f"one for each of {row.length} rows at {info.fps:g} a second, up to {last_s:.3f} s"
                raise InputError(where=f"{path}: {row.id}", found=found, needed=needed, fix=_FIX)


def find_overlaps(info: DatasetInfo, rows: Sequence[EpisodeRow], keys: Sequence[str]) -> dict[str, InputError]:
    """Return an error for each episode that claims seconds of a video that another episode claims, by identity.

    Args:
        info: Of the data set.
        rows: All episodes.
        keys: Features of the cameras that are used.
    """
    errors: dict[str, InputError] = {}
    for key in keys:
        claims = []
        for row in rows:
            if f"{key}.file" in row.place:
                start_s = row.place[f"{key}.start_s"]
                end_s = start_s + row.lengths_s.get(key, row.length / info.fps)
                claims.append((row.video_file(info, key), start_s, end_s, row.id))
        latest = ("", 0.0, 0.0, "")
        for claim in sorted(claims):
            path, start_s, end_s, identity = claim
            end_s = min(end_s, latest[2])
            if path == latest[0] and end_s - start_s > _ROUNDING_STEPS / info.fps:
                seconds = f"{start_s:.6g} to {end_s:.6g} s of {PurePosixPath(path).name}"
                found, needed = f"{latest[3]} and {identity} claim {seconds}", "seconds of one episode only"
                error = InputError(where=storage.join(info.root, path), found=found, needed=needed, fix=_FIX_RANGES)
                errors.setdefault(latest[3], error)
                errors.setdefault(identity, error)
            latest = max(latest, claim, key=lambda one: (one[0], one[2]))
    return errors


def row_of(table: EpisodeTable, index: int) -> EpisodeRow:
    """Return the location of an episode of a table; its task stays in the table."""
    return EpisodeRow(
        int(table.num_steps[index]), {name: column[index].item() for name, column in table.locators.items()}
    )
