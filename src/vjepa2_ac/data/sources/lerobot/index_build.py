"""Index of the usable episodes of a LeRobot data set and their locations: a table for `index_cache` to store."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import replace

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.data.index.episode_table import EpisodeTable
from vjepa2_ac.data.index.labels import Labels
from vjepa2_ac.data.index.state_hash import hash_of_states
from vjepa2_ac.data.selection import as_problem
from vjepa2_ac.data.sources.lerobot.episode_list import EpisodeRow, VideoPlace, data_file, video_file
from vjepa2_ac.data.sources.lerobot.episode_rows import EpisodeContent
from vjepa2_ac.data.sources.lerobot.info import DatasetInfo
from vjepa2_ac.data.sources.listing import in_parallel
from vjepa2_ac.episode import EpisodeInfo, Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import zero_steps

_FIX = "Copy the data set again, or leave the episode out"

Check = Callable[[EpisodeRow], EpisodeContent]  # reads an episode's rows


def find_problems(
    info: DatasetInfo, rows: Sequence[EpisodeRow], files: Set[str], keys: Sequence[str]
) -> dict[int, InputError]:
    """Return the problems of episodes that the data set's tables show, by number.

    Args:
        info: Of the data set.
        rows: Its episodes.
        files: The existing files, within the data set.
        keys: Features of the cameras that are used.
    """
    found = {row.index: _problem_of(info, row, files, keys) for row in rows}
    return {index: problem for index, problem in found.items() if problem is not None}


def check_rows(
    info: DatasetInfo,
    rows: Sequence[EpisodeRow],
    problems: dict[int, InputError],
    check: Check,
    *,
    connections: int,
    progress: Progress,
) -> list[EpisodeRow]:
    """Return the episodes with the facts in their rows; those that turn out unusable are added to `problems`.

    Raises:
        OSError: A remote file cannot be read.
    """
    by_file: dict[str, list[EpisodeRow]] = {}
    for row in rows:
        if row.index not in problems:
            by_file.setdefault(data_file(info, row), []).append(row)

    def check_file(file: str) -> list[EpisodeRow]:
        checked = []
        for row in by_file[file]:
            try:
                content = check(row)
            except InputError as error:
                problems[row.index] = error
                checked.append(row)
            else:
                success = row.success if content.success is None else content.success
                checked.append(replace(row, success=success, state_hash=hash_of_states(content.states)))
        return checked

    checked, done = [row for row in rows if row.index in problems], 0
    for of_file in in_parallel(check_file, list(by_file), connections):
        checked += of_file
        done += len(of_file)
        progress(done, len(rows))
    return sorted(checked, key=lambda row: row.index)


def table_of(rows: Sequence[EpisodeRow], problems: Mapping[int, InputError], texts: Mapping[str, str]) -> EpisodeTable:
    """Return the usable episodes as a table, and the problems of the others.

    Raises:
        InputError: No episode can be used: the first one's error.
    """
    usable = [row for row in rows if row.index not in problems]
    if not usable and problems:
        raise problems[min(problems)]
    task_of = ["; ".join(row.tasks) for row in usable]
    labels, hashes, tasks = Labels.of(task_of), [row.state_hash for row in usable], sorted(set(task_of))
    number = {task: place for place, task in enumerate(tasks)}
    locators: dict[str, np.ndarray] = {
        "index": np.array([row.index for row in usable], np.int64),
        "chunk": np.array([row.chunk for row in usable], np.int32),
        "file": np.array([row.file for row in usable], np.int32),
        "task": np.array([number[task] for task in task_of], np.int32),
    }
    for key in usable[0].videos if usable else ():
        places = [row.videos[key] for row in usable]
        locators[f"{key}.chunk"] = np.array([place.chunk for place in places], np.int32)
        locators[f"{key}.file"] = np.array([place.file for place in places], np.int32)
        locators[f"{key}.start_s"] = np.array([place.start_s for place in places], np.float64)
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
    at = {name: column[place] for name, column in table.locators.items()}
    keys = [name.removesuffix(".start_s") for name in at if name.endswith(".start_s")]
    videos = {
        key: VideoPlace(int(at[f"{key}.chunk"]), int(at[f"{key}.file"]), float(at[f"{key}.start_s"]), None)
        for key in keys
    }
    length = int(table.num_steps[place])
    return EpisodeRow(int(at["index"]), length, (), int(at["chunk"]), int(at["file"]), videos)


def _problem_of(info: DatasetInfo, row: EpisodeRow, files: Set[str], keys: Sequence[str]) -> InputError | None:
    if row.length == 0:
        return zero_steps(f"{info.root}: {row.id}")
    rows_in = data_file(info, row)
    if rows_in not in files:
        where, needed = f"{storage.join(info.root, rows_in)}: {row.id}", f"the {row.length} rows of the episode"
        return InputError(where=where, found="no such file", needed=needed, fix=_FIX)
    for key, place in row.videos.items():
        if key not in keys:
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
