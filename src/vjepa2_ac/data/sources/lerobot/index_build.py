"""Index of the usable episodes of a LeRobot data set and their locations: a table for `index_cache` to store."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.data.filters.broken_episodes import as_problem
from vjepa2_ac.data.index.episode_table import EpisodeTable
from vjepa2_ac.data.index.labels import Labels
from vjepa2_ac.data.index.state_hash import hash_of_states
from vjepa2_ac.data.sources.lerobot.episode_list import EpisodeRow, VideoPlace, data_file, video_file
from vjepa2_ac.data.sources.lerobot.episode_rows import EpisodeContent
from vjepa2_ac.data.sources.lerobot.info import DatasetInfo
from vjepa2_ac.episode import EpisodeInfo, Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import zero_steps

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
    found: dict[int, InputError] = {}
    for row in rows:
        try:
            _require_usable(info, row, files, keys)
        except InputError as error:
            found[row.index] = error
    return found


def check_rows(
    info: DatasetInfo,
    rows: Sequence[EpisodeRow],
    problems: dict[int, InputError],
    check: Check,
    *,
    connections: int,
    progress: Progress | None,
) -> list[EpisodeRow]:
    """Return the episodes with the facts in their rows; unusable ones are added to `problems`.

    Raises:
        OSError: A remote file cannot be read.
    """
    by_file: dict[str, list[EpisodeRow]] = {}
    for row in rows:
        if row.index not in problems:
            by_file.setdefault(data_file(info, row), []).append(row)
    done, checked = 0, []
    with ThreadPoolExecutor(max_workers=connections) as pool:
        for results in pool.map(lambda file: [_checked(row, check) for row in by_file[file]], by_file):
            for row, error in results:
                checked.append(row)
                if error is not None:
                    problems[row.index] = error
            done += len(results)
            if progress is not None:
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
    tasks = sorted({"; ".join(row.tasks) for row in usable})
    number = {task: place for place, task in enumerate(tasks)}
    hashes = [row.state_hash for row in usable]
    labels = Labels.of(["; ".join(row.tasks) for row in usable])
    locators: dict[str, np.ndarray] = {
        "index": np.array([row.index for row in usable], np.int64),
        "chunk": np.array([row.chunk for row in usable], np.int32),
        "file": np.array([row.file for row in usable], np.int32),
        "task": np.array([number["; ".join(row.tasks)] for row in usable], np.int32),
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
    at = table.locators
    keys = [name.removesuffix(".start_s") for name in at if name.endswith(".start_s")]
    return EpisodeRow(
        index=int(at["index"][place]),
        length=int(table.num_steps[place]),
        tasks=(),
        chunk=int(at["chunk"][place]),
        file=int(at["file"][place]),
        videos={
            key: VideoPlace(
                int(at[f"{key}.chunk"][place]), int(at[f"{key}.file"][place]), float(at[f"{key}.start_s"][place]), None
            )
            for key in keys
        },
    )


def _checked(row: EpisodeRow, check: Check) -> tuple[EpisodeRow, InputError | None]:
    try:
        content = check(row)
    except InputError as error:
        return row, error
    success = row.success if content.success is None else content.success
    return replace(row, success=success, state_hash=hash_of_states(content.states)), None


def _require_usable(info: DatasetInfo, row: EpisodeRow, files: Set[str], keys: Sequence[str]) -> None:
    if row.length == 0:
        raise zero_steps(f"{info.root}: {row.id}")
    rows_in = data_file(info, row)
    if rows_in not in files:
        raise InputError(
            where=f"{storage.join(info.root, rows_in)}: {row.id}",
            found="no such file",
            needed=f"the {row.length} rows of the episode",
            fix="Copy the data set again, or leave the episode out",
        )
    for key, place in row.videos.items():
        if key not in keys:
            continue
        shown_in = video_file(info, place, key)
        if shown_in not in files:
            raise InputError(
                where=f"{storage.join(info.root, shown_in)}: {row.id}",
                found=f"no such video, for {row.length} rows in {rows_in}",
                needed=f"the frames of {key}",
                fix="Copy the data set again, or leave the episode out",
            )
        needed_s = (row.length - 0.5) / info.fps
        if place.length_s is not None and not place.length_s > needed_s:
            raise InputError(
                where=f"{storage.join(info.root, shown_in)}: {row.id}",
                found=f"{place.length_s:.3f} s of video, says the data set, for {row.length} rows in {rows_in}",
                needed=f"{row.length / info.fps:.3f} s",
                fix="Leave the episode out",
            )
