"""Source of LeRobot data sets v3.0 and v2.1, read with pyarrow and PyAV, without lerobot itself."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import LeRobotData
from vjepa2_ac.config.section import Affects, knobs_that_affect
from vjepa2_ac.data.cache import fetched_data
from vjepa2_ac.data.index import EpisodeTable, get_or_build, hash_of_states, index_key
from vjepa2_ac.data.sources.indexed_source import FramesByStep, IndexedSource, Opened
from vjepa2_ac.data.sources.lerobot.episodes import (
    TABLES,
    EpisodeRow,
    data_file,
    problem_of,
    read_episodes,
    row_of,
    table_of,
    video_file,
)
from vjepa2_ac.data.sources.lerobot.info import DatasetInfo, list_by_template, read_info
from vjepa2_ac.data.sources.lerobot.parquet import ParquetRows
from vjepa2_ac.data.sources.lerobot.states import EpisodeContent, content_of, wanted_columns
from vjepa2_ac.data.sources.listing import in_parallel
from vjepa2_ac.episode import Episode, Progress, StepRanges
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import decode_image, require_bounded
from vjepa2_ac.media.video import Clock, read_frames, video_library
from vjepa2_ac.storage.block_file import BlockCachedFile
from vjepa2_ac.storage.structured import json_list

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Opened(Opened):
    info: DatasetInfo


class LeRobotSource(IndexedSource[LeRobotData, _Opened]):
    """The episodes of a LeRobot data set, v3.0 or v2.1, in the order of their numbers.

    Of a local data set `infos` checks the states of every episode; of a remote one it reads the files in meta, and
    states are checked when an episode is read (all of them at once if `data.outcome` needs a value that only the rows
    have). `read` fetches the row groups with the episode's rows; frames are fetched and decoded on request.
    """

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - frames are fetched one by one
        """Return one episode; see `episode.EpisodeSource`.

        Raises:
            InputError: Its rows are missing or damaged, lack a column, or have implausible states.
            OSError: They are remote and cannot be read.
        """
        table = self.infos()
        info, row = table[index], row_of(table, index)
        content = self._content(row)
        task = self._tasks[table.locators["task"][index]]
        key = self._info.camera_key(self._config.lerobot, camera or self._config.cameras[0])
        return Episode(
            info=info,
            states=content.states,
            read_frames=self._frames(row, key),
            control_rate_hz=self._control_rate_hz,
            joint_velocities=content.joint_velocities,
            metadata={"language": task} if task else {},
            commands=content.commands,
        )

    @cached_property
    def _info(self) -> DatasetInfo:
        return read_info(self._config.path) if self._known is None else self._known.info

    @property
    def _control_rate_hz(self) -> float:
        return self._config.lerobot.fps or self._info.fps

    @cached_property
    def _tasks(self) -> list[str]:
        return json_list(self.infos().texts["tasks"], where="the tasks of the index")

    @cached_property
    def _parquet(self) -> ParquetRows:
        cache = fetched_data(self._config.disk_cache)
        return ParquetRows(self._open_file, wanted_columns(self._config), cache, self._data_version)

    @property
    def _is_far(self) -> bool:
        return storage.is_url(self._config.path)

    @property
    def _data_version(self) -> str:
        """A version that changes with the data set's files and the wanted columns."""
        return self._version if self._known is None else self._known.table.texts["version"]

    def _open_file(self, path: str) -> str | BlockCachedFile:
        return self._files.open(path, version=self._data_version)

    def _look(self, progress: Progress) -> _Opened:
        info, config = self._info, self._config
        info.require_mapping(config)
        keys = [info.camera_key(config.lerobot, camera) for camera in config.cameras]
        if any(info.features[key].dtype == "video" for key in keys):
            video_library(info.where)
        tables = list_by_template(info.root, TABLES[info.version], connections=self._connections)
        files = list_by_template(info.root, info.data_path, connections=self._connections)
        for key in keys:
            if info.features[key].dtype == "video":
                files |= list_by_template(info.root, info.video_path or "", key, connections=self._connections)
        fields = knobs_that_affect(Affects.INDEX, config.lerobot)
        fields.pop("action")  # where it matters, it is among the columns
        parts = {
            **({"vector": wanted_columns(config)} if config.states == "vector" else {}),
            "source": "lerobot",
            "fields": fields,
            "keys": keys,
            "outcome": self._is_far and config.outcome != "all",
            "info": repr(replace(info, root="")),
            "files": [(path, file.size, file.version) for path, file in [*tables.items(), *files.items()]],
        }
        self._version = index_key(parts, config.path)
        build = partial(self._built, list(tables), files.keys(), keys, progress)
        return _Opened(get_or_build(config.disk_cache, self._version, config.path, build), info)

    def _built(self, tables: list[str], files: Set[str], keys: list[str], progress: Progress) -> EpisodeTable:
        info, fields = self._info, self._config.lerobot
        of_config = [key for key in dict.fromkeys(fields.cameras.values()) if key in info.features]
        videos = [key for key in of_config if info.features[key].dtype == "video"]
        states = fields.state if self._is_far else ()  # of local rows the states themselves are hashed
        rows = read_episodes(info, tables, videos, states, fields.success, self._open_file)
        found = {row.index: problem_of(info, row, files, keys) for row in rows}
        problems = {index: problem for index, problem in found.items() if problem is not None}
        outcome_unknown = any(row.success is None for row in rows) and fields.success in info.features
        if not self._is_far or (self._config.outcome != "all" and outcome_unknown):
            rows = self._with_content(rows, problems, progress)
        if not rows:
            raise InputError(where=info.where, found="no episodes", needed="a data set with episodes")
        texts = {"version": self._version, "control_rate_hz": str(self._control_rate_hz)}
        table = table_of(rows, problems, texts)
        logger.info("%s: %d episodes, %d steps", info.root, len(table), int(table.num_steps.sum()))
        return table

    def _with_content(
        self, rows: list[EpisodeRow], problems: dict[int, InputError], progress: Progress
    ) -> list[EpisodeRow]:
        """Return the episodes with the facts in their rows; those that turn out unusable are added to `problems`."""
        by_file: dict[str, list[EpisodeRow]] = {}
        for row in rows:
            if row.index not in problems:
                by_file.setdefault(data_file(self._info, row), []).append(row)

        def checked(row: EpisodeRow) -> EpisodeRow:
            try:
                content = self._content(row)
            except InputError as error:
                problems[row.index] = error
                return row
            success = row.success if content.success is None else content.success
            return replace(row, success=success, state_hash=hash_of_states(content.states))

        read, done = [row for row in rows if row.index in problems], 0
        for of_file in in_parallel(lambda some: [checked(row) for row in some], [*by_file.values()], self._connections):
            read += of_file
            done += len(of_file)
            progress(done, len(rows))
        return sorted(read, key=lambda row: row.index)

    def _content(self, row: EpisodeRow) -> EpisodeContent:
        rows = self._parquet.rows(storage.join(self._info.root, data_file(self._info, row)), row.index)
        return content_of(rows, row.length, self._info, self._config, self._where(row))

    def _frames(self, row: EpisodeRow, key: str) -> FramesByStep:
        info = self._info
        if info.features[key].dtype == "image":
            path, where = storage.join(info.root, data_file(info, row)), f"{self._where(row)}: {key}"
            read = cache(partial(self._parquet.images, path, key, row.index))
            return FramesByStep(row.length, where, partial(_stored_images, read, row.length, where))
        place = row.videos[key]
        path = storage.join(info.root, video_file(info, place, key))
        clock, where = Clock(start_s=place.start_s, rate_hz=info.fps), f"{path}: {row.id}"
        return FramesByStep(row.length, where, partial(self._video_frames, path, clock, where))

    def _video_frames(
        self, path: str, clock: Clock, where: str, steps: Sequence[int]
    ) -> UInt8[np.ndarray, "time height width 3"]:
        """Return frames of an episode's part of a video: step k is shown at the part's start + k / fps."""
        return read_frames(self._open_file(path), steps, where=where, clock=clock)

    def _where(self, row: EpisodeRow) -> str:
        return f"{storage.join(self._info.root, data_file(self._info, row))}: {row.id}"


def _stored_images(
    read: Callable[[], list[bytes]], num_steps: int, where: str, steps: Sequence[int]
) -> UInt8[np.ndarray, "time height width 3"]:
    """Return frames from an episode's PNG or JPEG images in the table, all of which are read."""
    images = read()
    if len(images) != num_steps:
        raise InputError(where=where, found=f"{len(images)} images", needed=f"one for each of {num_steps} steps")
    frames: list[UInt8[np.ndarray, "height width 3"]] = []
    for step in steps:
        at = f"{where}: step {step}"
        frame = decode_image(images[step], at)
        require_bounded(frame.shape[0], frame.shape[1], at, count=len(steps))
        if frames and frame.shape != frames[0].shape:
            found, needed = (f"an image of {one.shape[0]}x{one.shape[1]}" for one in (frame, frames[0]))
            raise InputError(where=at, found=found, needed=f"{needed}, as at step {steps[0]}")
        frames.append(frame)
    return np.stack(frames)
