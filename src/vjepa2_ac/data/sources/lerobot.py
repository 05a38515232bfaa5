"""Source of LeRobot data sets v3.0 and v2.1, read with pyarrow and PyAV, without lerobot itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set
from dataclasses import replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import LeRobotData
from vjepa2_ac.config.sources import JOINT_VELOCITY
from vjepa2_ac.data.files import map_in_threads, num_connections
from vjepa2_ac.data.index import (
    STATES_NOT_READ,
    EpisodeProblem,
    EpisodeTable,
    get_or_build_index,
    index_key,
    summarize_states,
)
from vjepa2_ac.data.poses import convert_poses
from vjepa2_ac.data.selection import add_split_labels
from vjepa2_ac.data.sources.indexed_source import IndexedSource, IndexEntry, ScanResult, build_table, make_frame_reader
from vjepa2_ac.data.sources.lerobot_meta import (
    FIX_EPISODE,
    TABLES,
    DatasetInfo,
    EpisodeRow,
    find_overlaps,
    get_row,
    list_by_template,
    missing_error,
    read_episode_rows,
    read_info,
    require_files,
    require_video_lengths,
)
from vjepa2_ac.data.sources.parquet import EPISODE_COLUMN, Columns, ParquetRows
from vjepa2_ac.episode import Episode, EpisodeInfo, FrameReader, Progress, StepRanges
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.media.images import decode_image, stack_frames
from vjepa2_ac.media.video import Clock, import_pyav, read_frames, read_header
from vjepa2_ac.spaces import require_finite
from vjepa2_ac.storage.block_file import BlockCachedFile

FRAME_COLUMN, TIME_COLUMN = "frame_index", "timestamp"

_DATA_BYTES = "data_bytes"  # total size of the Parquet files with rows
_CHECKS = 2  # version of the checks while indexing and of the selection of frames; a new number rebuilds all indexes

_FIX_VECTORS = "Exclude the episode, or check data.lerobot.state and data.lerobot.action"

EpisodeArrays = dict[str, Any]
"""The data of an episode except its frames, by the names of `Episode`: states, commands, joint_velocities."""


class LeRobotSource(IndexedSource[LeRobotData, DatasetInfo]):
    """The episodes of a LeRobot data set, v3.0 or v2.1, in the order of their numbers.

    For a local data set `infos` checks the states of every episode and the headers of the videos. For a remote data set
    `infos` reads only the files in meta, and states are checked when an episode is read. `infos` reads all states of a
    remote data set only if `data.outcome` needs a value from the rows. `read` fetches the row groups with the episode's
    rows. Frames are fetched and decoded on request.
    """

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - frames are fetched one by one
        """Return an episode; see `episode.EpisodeSource`.

        Raises:
            InputError: The rows are missing or damaged, lack a column, or have implausible states.
            OSError: The rows are remote and cannot be read.
        """
        table = self.infos()
        info, row = table[index], get_row(table, index)
        content, _ = self._read_arrays(row)
        task = table.label("task", index)
        key = self._info.get_camera_key(self._config.lerobot, camera or self._config.cameras[0])
        return Episode(
            info=info,
            read_frames=self._make_frame_reader(row, key),
            control_rate_hz=self._info.fps,
            metadata={"language": task} if task else {},
            **content,
        )

    @cached_property
    def _info(self) -> DatasetInfo:
        return read_info(self._config.path) if self._index_and_state is None else self._index_and_state[1]

    @cached_property
    def _parquet(self) -> ParquetRows:
        return ParquetRows(self._files, select_columns(self._config), self._data_version)

    @property
    def _data_version(self) -> str:
        """A version that changes with the data set's files and the required columns."""
        return self._version if self._index_and_state is None else self._index_and_state[0].texts["index"]

    def _open_file(self, path: str) -> str | BlockCachedFile:
        return self._files.open(path, version=self._data_version)

    def _open_data_set(self, progress: Progress) -> tuple[EpisodeTable, DatasetInfo]:
        info, config = self._info, self._config
        info.require_mapping(config)
        keys = [info.get_camera_key(config.lerobot, camera) for camera in config.cameras]
        if any(info.features[key].dtype == "video" for key in keys):
            import_pyav(info.where)
        list_files = partial(list_by_template, info.root, connections=num_connections(config))
        tables, files = list_files(TABLES[info.version]), list_files(info.data_path)
        num_bytes = sum(file.size for file in files.values())
        for key in keys:
            if info.features[key].dtype == "video":
                files |= list_files(info.video_path or "", key)
        fields = config.format_values["lerobot"]
        fields.pop("action")  # `select_columns` includes the columns of actions if they are read
        parts = {
            **({"vector": select_columns(config)} if config.states == "vector" else {}),
            "source": "lerobot",
            "checks": _CHECKS,
            "fields": fields,
            "keys": keys,
            "outcome": storage.is_url(config.path) and config.outcome != "all",
            "info": repr(replace(info, root="")),
            "files": [(path, file.size, file.version) for path, file in [*tables.items(), *files.items()]],
        }
        self._version = index_key(parts, config.path)
        build = partial(self._build_table, list(tables), files.keys(), keys, progress)
        table = get_or_build_index(config.disk_cache, self._version, config.path, build)
        table = replace(table, texts={**table.texts, _DATA_BYTES: str(num_bytes)})
        return add_split_labels(table, [info.get_split(number) for number in table.locators["index"].tolist()]), info

    def _build_table(self, tables: list[str], files: Set[str], keys: list[str], progress: Progress) -> EpisodeTable:
        info, config, fields = self._info, self._config, self._config.lerobot
        is_remote, connections = storage.is_url(config.path), num_connections(config)
        camera_keys = [key for key in dict.fromkeys(fields.cameras.values()) if key in info.features]
        videos = [key for key in camera_keys if info.features[key].dtype == "video"]
        rows = read_episode_rows(info, tables, videos, fields.success, self._open_file)
        if not rows:
            raise InputError(where=info.where, found="the data set has no episodes", needed="at least one episode")
        outcome_unknown = any(row.success is None for row in rows) and fields.success in info.features
        reads_rows = not is_remote or (config.outcome != "all" and outcome_unknown)
        overlaps = find_overlaps(info, rows, keys)
        read_cached_header = cache(lambda path: read_header(path, where=path))

        def scan(row: EpisodeRow) -> ScanResult:
            success, summary = row.success, STATES_NOT_READ
            try:
                require_files(info, row, files, keys)
                if row.id in overlaps:
                    raise overlaps[row.id]
                if reads_rows:
                    content, outcome = self._read_arrays(row)
                    success = success if outcome is None else outcome
                    summary = summarize_states(content["states"])
                if not is_remote:
                    require_video_lengths(info, row, keys, read_cached_header)
            except InputError as error:
                return EpisodeProblem.from_error(error, row.id)
            episode_info, labels = EpisodeInfo(row.id, row.length, success), {"task": row.task}
            return IndexEntry(episode_info, self._where(row), row.locator, summary, labels, self._info.fps)

        by_file: dict[str, list[EpisodeRow]] = {}  # grouped, so that each row group is decoded once
        for row in rows:
            by_file.setdefault(row.data_file(info), []).append(row)
        results: dict[str, ScanResult] = {}
        scan_file = lambda file_rows: [(row.id, scan(row)) for row in file_rows]  # noqa: E731
        for file_results in map_in_threads(scan_file, [*by_file.values()], connections):
            results.update(file_results)
            progress(len(results), len(rows))
        return build_table([results[row.id] for row in rows], config, len(rows))

    def _read_arrays(self, row: EpisodeRow) -> tuple[EpisodeArrays, bool | None]:
        """Return the data in the rows of an episode, and whether the episode succeeded (None: unknown).

        Raises:
            InputError: Rows or columns are missing, a column has another width, or the states are implausible.
        """
        info, config, where = self._info, self._config, self._where(row)
        rows = self._parquet.read_rows(storage.join(info.root, row.data_file(info)), row.index)
        fields = config.lerobot
        _require_rows(rows, row.length, info.fps, where)

        def get_column(name: str) -> Float[np.ndarray, "steps width"]:
            if name not in rows:
                raise missing_error("data.lerobot", "column", name, where, rows)
            feature, width = info.features.get(name), rows[name].shape[1]
            if feature is not None and width != feature.width:
                problem, needed = f"{width} numbers per row", f"{feature.width}, according to {info.where}"
                raise InputError(where=f"{where}: {name}", found=problem, needed=needed, fix=FIX_EPISODE)
            return rows[name].astype(np.float64)

        def concatenate(names: Sequence[str]) -> Float[np.ndarray, "steps width"]:
            numbers = np.concatenate([get_column(name) for name in names], axis=1)
            require_finite(numbers, where, fix=_FIX_VECTORS)
            return numbers

        def get_optional_column(name: str | None) -> Float[np.ndarray, "steps width"] | None:
            """Return a column, or None if the data set lacks the column. Otherwise every file must have it."""
            return None if name is None or (name not in rows and name not in info.features) else get_column(name)

        states, success = concatenate(fields.state), get_optional_column(fields.success)
        if fields.select is not None:
            states = states[:, list(fields.select)]
        content = {
            "states": convert_poses(states, fields, where, section="data.lerobot")
            if config.states == "pose"
            else states,
            "commands": concatenate(fields.action) if config.actions == "recorded" else None,
            "joint_velocities": None if get_optional_column(JOINT_VELOCITY) is None else concatenate([JOINT_VELOCITY]),
        }
        return content, None if success is None else bool(success.any())

    def _make_frame_reader(self, row: EpisodeRow, key: str) -> FrameReader:
        info = self._info
        if info.features[key].dtype == "image":
            path = storage.join(info.root, row.data_file(info))
            read_all = cache(partial(self._parquet.read_images, path, key, row.index))
            read = partial(self._read_stored_frames, row, key, read_all)
            return make_frame_reader(row.length, f"{self._where(row)}: {key}", read)
        path, start_s = storage.join(info.root, row.video_file(info, key)), row.locator[f"{key}.start_s"]
        clock, where = Clock(start_s=start_s, rate_hz=info.fps, source=info.where), f"{path}: {row.id}"
        return make_frame_reader(
            row.length, where, lambda steps: read_frames(self._open_file(path), steps, where=where, clock=clock)
        )

    def _read_stored_frames(
        self, row: EpisodeRow, key: str, read_all: Callable[[], list[bytes]], steps: Sequence[int]
    ) -> UInt8[np.ndarray, "time height width 3"]:
        """Return frames from an episode's PNG or JPEG images in the table.

        A table can only be read for whole episodes, so the images are stored in the disk cache, which can return single
        images. The images of a data set larger than the disk cache are not stored, because each clip would write an
        episode and evict another.
        """
        where, entry = f"{self._where(row)}: {key}", f"images {self._data_version} {key} {row.id}"
        images = self._files.cache.read_parts(entry, row.length, steps)
        if images is None:
            all_images = read_all()
            if len(all_images) != row.length:
                problem, needed = f"{len(all_images)} images", f"one image for each of {counted(row.length, 'step')}"
                raise InputError(where=where, found=problem, needed=needed)
            if int(self.infos().texts[_DATA_BYTES]) <= self._config.disk_cache.limit_gb * 1e9:
                self._files.cache.write_parts(entry, all_images)
            images = [all_images[step] for step in steps]
        frames = (decode_image(image, f"{where}: step {step}") for image, step in zip(images, steps, strict=True))
        return stack_frames(frames, steps, where)

    def _where(self, row: EpisodeRow) -> str:
        return f"{storage.join(self._info.root, row.data_file(self._info))}: {row.id}"


def select_columns(config: LeRobotData) -> list[str]:
    """Return the names of the columns that are read if a file has them."""
    fields = config.lerobot
    optional_columns = [JOINT_VELOCITY, *((fields.success,) if fields.success else ())]
    commands = fields.action if config.actions == "recorded" else ()
    return [EPISODE_COLUMN, FRAME_COLUMN, TIME_COLUMN, *fields.state, *commands, *optional_columns]


def _require_rows(rows: Columns, length: int, fps: float, where: str) -> None:
    """Check that the rows of an episode are complete, in order, and at the data set's rate."""
    count = len(rows[EPISODE_COLUMN]) if rows else 0
    if count != length:
        raise InputError(
            where=where,
            found=counted(count, "row"),
            needed=f"{length}, according to the files in meta",
            fix=FIX_EPISODE,
        )
    order = np.arange(length)
    if FRAME_COLUMN in rows and not np.array_equal(rows[FRAME_COLUMN][:, 0], order):
        problem = f"{FRAME_COLUMN} does not count from 0 to {length - 1}"
        raise InputError(where=where, found=problem, needed="one row for each step, in order", fix=FIX_EPISODE)
    if TIME_COLUMN not in rows:
        return
    errors_s = abs(rows[TIME_COLUMN][:, 0] - order / fps)
    if not errors_s.max() < 0.5 / fps:  # not >=, so that NaN is refused
        step = int(np.argmax(~(errors_s < 0.5 / fps)))
        problem = f"{TIME_COLUMN} {rows[TIME_COLUMN][step, 0]:.4g} s"
        needed = f"{step / fps:.4g} s, at the {fps:g} rows per second of meta/info.json"
        fix = "Correct fps in meta/info.json, or exclude the episode"
        raise InputError(where=f"{where}: step {step}", found=problem, needed=needed, fix=fix)
