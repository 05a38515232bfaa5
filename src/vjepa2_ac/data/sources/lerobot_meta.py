"""The files in meta of a LeRobot data set: meta/info.json (rate, columns, cameras), and the tables of its episodes."""

from __future__ import annotations

import glob
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import PurePosixPath
from typing import Any

from vjepa2_ac import storage
from vjepa2_ac.config import LeRobotData, LeRobotFields
from vjepa2_ac.data.files import map_in_threads
from vjepa2_ac.data.index import EpisodeTable
from vjepa2_ac.data.poses import require_selection
from vjepa2_ac.data.sources.parquet import read_table
from vjepa2_ac.errors import InputError, MissingFileError, counted, did_you_mean
from vjepa2_ac.media.video import VideoHeader, is_depth_format
from vjepa2_ac.spaces import no_steps_error
from vjepa2_ac.storage import FileInfo
from vjepa2_ac.storage.block_file import BlockCachedFile
from vjepa2_ac.storage.structured import parse_json_object, read_json_object

INFO = "meta/info.json"
VERSIONS = ("v2.1", "v3.0")

_PLACEHOLDER = re.compile(r"\{(?:(video_key)|(?:chunk_index|file_index|episode_chunk|episode_index)(?::0\dd)?)\}")
_FIX = "Download meta/info.json again"
_FIX_VERSION = (
    "Convert older data sets to v2.1 with convert_dataset_v1_to_v2.py and convert_dataset_v20_to_v21.py of lerobot "
    "0.3.3; for newer versions update vjepa2-ac"
)
_FIX_STORAGE = "`vjepa2-ac data converter lance_to_files` prints a script that converts a Lance table to these files"
_FIX_HUB = "Check the name in hf://datasets/owner/name; for a private data set, run `hf auth login` or set HF_TOKEN"
TABLES = {  # path templates of the files that list the episodes
    "v2.1": "meta/episodes.jsonl",
    "v3.0": "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}
FIX_EPISODE = "Copy the data set again, or exclude the episode"
_MAX_BYTES = 1 << 28  # size limit of meta/episodes.jsonl
_FIX_TABLES = "Download the files in meta again"
_FIX_RANGES = (
    "Correct file_index, from_timestamp and to_timestamp in meta/episodes (they may be wrong for other episodes of the "
    "file, too), or exclude both episodes"
)
_ROUNDING_STEPS = 0.25  # the ranges of two episodes in a video may overlap by this many steps


@dataclass(frozen=True)
class Feature:
    """A column of numbers, or a camera, as described in meta/info.json."""

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] = ()
    is_depth: bool = field(default=False, repr=False)  # not in the key of stored indexes

    @property
    def width(self) -> int:
        """How many numbers the feature has per step."""
        return math.prod(self.shape)

    @property
    def is_camera(self) -> bool:
        """Whether the feature holds colour images of a camera."""
        return self.dtype in {"video", "image"} and not self.is_depth

    @property
    def is_numbers(self) -> bool:
        """Whether the feature is a column of numbers."""
        return self.dtype.startswith(("float", "int", "uint", "bool"))


@dataclass(frozen=True)
class DatasetInfo:
    """The used part of meta/info.json."""

    root: str
    version: str
    fps: float
    episodes: int
    frames: int | None  # total number of frames; None: not stated
    chunk_episodes: int  # v2.1: episodes per chunk folder
    data_path: str
    video_path: str | None
    features: Mapping[str, Feature]
    splits: Mapping[str, range] = field(default_factory=dict, repr=False)  # not in the key of stored indexes

    @property
    def where(self) -> str:
        """The path of meta/info.json."""
        return storage.join(self.root, INFO)

    def get_split(self, episode: int) -> str | None:
        """Return the name of the split that contains an episode number, or None."""
        return next((name for name, episodes in self.splits.items() if episode in episodes), None)

    def require_mapping(self, config: LeRobotData) -> None:
        """Check that the data set has the columns and cameras of the config, before large files are read.

        Raises:
            InputError: A column or camera is missing (lists the existing ones), or the columns do not form a state.
        """
        fields = config.lerobot
        columns = [name for name, feature in self.features.items() if feature.is_numbers]
        columns_by_key = {"state": fields.state, "action": fields.action if config.actions == "recorded" else ()}
        for key, names in columns_by_key.items():
            for name in names:
                if name not in columns:
                    raise missing_error(f"data.lerobot.{key}", "column of numbers", name, self.where, columns)
        state_columns = {}
        for name in fields.state:
            feature = self.features[name]
            described = ", ".join(feature.names) if len(feature.names) == feature.width else feature.width
            state_columns[f"{name} [{described}]"] = feature.width
        require_selection(state_columns, fields, "data.lerobot", is_pose=config.states == "pose")
        for camera in config.cameras:
            self.get_camera_key(fields, camera)

    def get_camera_key(self, fields: LeRobotFields, camera: str) -> str:
        """Return the name of the feature with a camera's frames.

        Raises:
            InputError: The config or the data set has no such camera.
        """
        if camera not in fields.cameras:
            raise missing_error("data.camera", "camera", camera, "data.lerobot.cameras", fields.cameras)
        key = fields.cameras[camera]
        cameras = [name for name, feature in self.features.items() if feature.is_camera]
        if key not in cameras:
            raise missing_error(f"data.lerobot.cameras.{camera}", "camera", key, self.where, cameras)
        if self.features[key].dtype == "video" and self.video_path is None:
            problem = f"{key} is a video, but video_path is missing"
            raise InputError(where=self.where, found=problem, needed="the path template of the videos", fix=_FIX)
        return key


def missing_error(where: str, kind: str, name: str, container: str, existing: Iterable[str]) -> InputError:
    """Return an error about a missing name, with the existing names and a suggestion."""
    existing = list(existing)
    needed = f"one of {', '.join(existing)}" if existing else ""
    problem = f"no {kind} {name} in {container}" + ("" if existing else f", which has no {kind}")
    return InputError(where=where, found=problem, needed=needed, fix=did_you_mean(name, existing).strip())


def read_info(root: str) -> DatasetInfo:
    """Read meta/info.json.

    Raises:
        InputError: There is no data set, it has an unsupported version, or the file is damaged.
        UnreachableError: The file cannot be read.
    """
    where = storage.join(root, INFO)
    try:
        content = read_json_object(where, needed="a description of a data set", fix=_FIX)
    except MissingFileError:
        fix = _FIX_HUB if root.startswith("hf://") else "Set data.path to the folder with meta, data and videos"
        problem = f"no {INFO} in {root}"
        raise InputError(where="data.path", found=problem, needed="a LeRobot data set", fix=fix) from None
    if (version := content.get("codebase_version")) not in VERSIONS:
        problem = f"codebase_version {version!r}"
        raise InputError(where=where, found=problem, needed=" or ".join(VERSIONS), fix=_FIX_VERSION)
    if (stored_as := content.get("storage_format") or "parquet") != "parquet":
        problem = f"storage_format {stored_as!r}"
        raise InputError(where=where, found=problem, needed="Parquet files and MP4 videos", fix=_FIX_STORAGE)
    try:
        return _parse_info(root, content)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        problem = f"not a valid data set description ({error!r})"
        raise InputError(where=where, found=problem, needed="meta/info.json as written by LeRobot", fix=_FIX) from None


def _parse_info(root: str, content: Mapping[str, Any]) -> DatasetInfo:
    video_path = content.get("video_path")
    fps, episodes, chunk = float(content["fps"]), content["total_episodes"], content.get("chunks_size", 1000)
    frames = content.get("total_frames")
    if not 0 < fps <= 1000 or type(episodes) is not int or type(chunk) is not int or episodes < 0 or chunk < 1:
        raise ValueError(f"fps {fps}, total_episodes {episodes}, chunks_size {chunk}")
    return DatasetInfo(
        root=root,
        version=content["codebase_version"],
        fps=fps,
        episodes=episodes,
        frames=frames if type(frames) is int else None,
        chunk_episodes=chunk,
        data_path=_require_safe_template(content["data_path"]),
        video_path=None if video_path is None else _require_safe_template(video_path),
        features={name: _parse_feature(feature) for name, feature in content["features"].items()},
        splits=_parse_splits(content.get("splits")),
    )


def _parse_splits(content: object) -> dict[str, range]:
    """Parse the ranges of episodes of each split, such as {"train": "0:50"}; other notations are ignored."""
    texts = content if isinstance(content, Mapping) else {}
    ranges = {str(name): re.fullmatch(r"(\d{1,9}):(\d{1,9})", str(text)) for name, text in texts.items()}
    return {name: range(int(part[1]), int(part[2])) for name, part in ranges.items() if part}


def _parse_feature(content: Mapping[str, Any]) -> Feature:
    """Parse a feature; depth maps are recognised by the flags of any LeRobot version, or by their pixel format.

    Source: huggingface/lerobot @ 7427f31, src/lerobot/configs/video.py, is_depth_map.
    """
    dtype, shape, names = content["dtype"], tuple(content["shape"]), content.get("names")
    if not isinstance(dtype, str) or not all(type(size) is int and size > 0 for size in shape):
        raise TypeError(f"invalid feature with dtype {dtype!r} and shape {shape!r}")
    if isinstance(names, dict) and all(type(index) is int for index in names.values()):  # {"x": 0, "y": 1, ...}
        names = sorted(names, key=names.__getitem__)
    elif isinstance(names, dict) and len(names) == 1:  # {"motors": ["x", "y", ...]}, as in older ports
        names = next(iter(names.values()))
    video_infos = [info for info in (content.get("info"), content.get("video_info")) if isinstance(info, Mapping)]
    is_depth = any(
        info.get("is_depth_map") or info.get("video.is_depth_map") or is_depth_format(str(info.get("video.pix_fmt")))
        for info in video_infos
    )
    return Feature(dtype, shape, tuple(map(str, names)) if isinstance(names, list) else (), is_depth)


def _require_safe_template(template: str) -> str:
    """Check a path template such as `chunk-{chunk_index:03d}`, which must stay inside the data set, and return it."""
    has_other_fields = re.search("[{}]", _PLACEHOLDER.sub("", template)) is not None
    if not template or template.startswith("/") or ".." in template.split("/") or has_other_fields:
        raise ValueError(f"invalid path template {template!r}")
    return template


def fill_template(template: str, chunk: int, file: int, key: str = "") -> str:
    """Return the path of a file in the data set: in v3.0 by chunk and file, in v2.1 by chunk and episode."""
    return template.format(chunk_index=chunk, episode_chunk=chunk, file_index=file, episode_index=file, video_key=key)


def list_by_template(root: str, template: str, key: str = "", *, connections: int = 1) -> dict[str, FileInfo]:
    """Return the files whose paths match a template, by path in the data set, sorted.

    Raises:
        InputError: A file is a git-lfs pointer.
        OSError: A folder cannot be listed.
    """
    pattern = _PLACEHOLDER.sub(lambda match: glob.escape(key) if match[1] else "[0-9]*", template)
    *folders, file_pattern = pattern.split("/")
    matches = [""]
    for part in folders:
        names = {
            folder: storage.list_names(storage.join(root, folder)) if "[" in part else [part] for folder in matches
        }
        matches = [f"{folder}{name}/" for folder in matches for name in names[folder] if fnmatchcase(name, part)]
    listings = map_in_threads(lambda folder: storage.list_files(storage.join(root, folder)), matches, connections)
    files = [(folder, file) for folder, listing in zip(matches, listings, strict=True) for file in listing]
    matching_files = dict(
        sorted((f"{folder}{file.name}", file) for folder, file in files if fnmatchcase(file.name, file_pattern))
    )
    for path, file in matching_files.items():
        storage.require_regular_file(storage.join(root, path), file.size)
    return matching_files


# ---- the episodes ----


@dataclass(frozen=True)
class EpisodeRow:
    """The entry of one episode in the data set's tables."""

    length: int
    locator: Mapping[str, float]  # index; chunk and file of its rows; KEY.chunk, KEY.file and KEY.start_s of each video
    task: str = ""
    lengths_s: Mapping[str, float] = field(default_factory=dict)  # duration in each video, if the table has it
    success: bool | None = None

    @property
    def index(self) -> int:
        """The number of the episode."""
        return int(self.locator["index"])

    @property
    def id(self) -> str:
        """The identity of the episode: its number, the only name in LeRobot."""
        return f"episode_{self.index:06d}"

    def data_file(self, info: DatasetInfo) -> str:
        """Return the path, in the data set, of the file with the episode's rows."""
        return fill_template(info.data_path, int(self.locator["chunk"]), int(self.locator["file"]))

    def video_file(self, info: DatasetInfo, key: str) -> str:
        """Return the path, in the data set, of the video with the episode's frames."""
        chunk, file = (int(self.locator[f"{key}.{part}"]) for part in ("chunk", "file"))
        return fill_template(info.video_path or "", chunk, file, key)


def read_episode_rows(
    info: DatasetInfo,
    tables: Sequence[str],
    videos: Sequence[str],
    success: str | None,
    open_file: Callable[[str], str | BlockCachedFile],
) -> list[EpisodeRow]:
    """Read the entries of all episodes, sorted by number.

    Args:
        info: Description of the data set.
        tables: Paths, in the data set, of the files that list the episodes.
        videos: Video features whose locations are required.
        success: Column whose statistics contain the outcome; not available in v2.1.
        open_file: Returns the local path or the open remote file of a path.

    Raises:
        InputError: The tables are missing, damaged, or do not match the count in meta/info.json.
        OSError: A remote file cannot be read.
    """
    outcome = f"stats/{success}/max"
    columns_read = {"episode_index", "length", "tasks", "data/chunk_index", "data/file_index", outcome}
    prefixes = tuple(f"videos/{key}/" for key in videos)
    rows = []
    for table in tables:
        path = storage.join(info.root, table)
        if info.version == "v2.1":
            values = list(_read_lines(path))
        else:
            columns = read_table(open_file(path), path, lambda name: name in columns_read or name.startswith(prefixes))
            values = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        for number, row in enumerate(values):
            try:
                rows.append(_parse_row(info, row, videos, row.get(outcome)))
            except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
                problem, needed = f"not an entry of an episode ({error!r})", "a table as written by LeRobot"
                raise InputError(where=f"{path}: row {number}", found=problem, needed=needed, fix=_FIX_TABLES) from None
    rows.sort(key=lambda row: row.index)
    numbers = {row.index for row in rows}
    if len(numbers) != len(rows) or len(rows) != info.episodes:
        where = storage.join(info.root, tables[0] if tables else "meta")
        problem = f"{counted(len(rows), 'episode')} with {len(numbers)} different values of episode_index"
        needed = f"{counted(info.episodes, 'episode')} with different values, according to {info.where}"
        raise InputError(where=where, found=problem, needed=needed, fix=_FIX_TABLES)
    return rows


def _read_lines(path: str) -> Iterator[dict[str, Any]]:
    """Yield the object on each line of meta/episodes.jsonl."""
    for number, line in enumerate(storage.read_small_file(path, _MAX_BYTES).splitlines(), start=1):
        if line.strip():
            where = f"{path}: line {number}"
            yield parse_json_object(line, where=where, needed="the entry of an episode", fix=_FIX_TABLES)


def _parse_row(info: DatasetInfo, row: Mapping[str, Any], videos: Sequence[str], outcome: object) -> EpisodeRow:
    index = int(row["episode_index"])
    if info.version == "v2.1":  # one file per episode
        prefixes = ("data", *(f"videos/{key}" for key in videos))
        row = {**row, **{f"{prefix}/chunk_index": index // info.chunk_episodes for prefix in prefixes}}
        row |= {f"{prefix}/file_index": index for prefix in prefixes}
        row |= {f"{prefix}/from_timestamp": 0 for prefix in prefixes}
    while isinstance(outcome, list) and outcome:
        outcome = outcome[0]
    tasks = row.get("tasks") or ()
    locator: dict[str, float] = {
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
        locator |= {f"{key}.{part}": int(row[f"{name}/{part}_index"]) for part in ("chunk", "file")}
        locator[f"{key}.start_s"] = start
        if end is not None:
            lengths_s[key] = float(end) - start
    return EpisodeRow(
        length=int(row["length"]),
        locator=locator,
        task="; ".join(map(str, tasks)) if isinstance(tasks, list | tuple) else str(tasks),
        lengths_s=lengths_s,
        success=bool(outcome) if isinstance(outcome, bool | int | float) else None,
    )


def require_files(info: DatasetInfo, row: EpisodeRow, files: Set[str], keys: Sequence[str]) -> None:
    """Refuse an episode that is unusable according to the tables of the data set.

    Args:
        info: Description of the data set.
        row: The episode.
        files: Paths of the existing files in the data set.
        keys: Features of the used cameras.

    Raises:
        InputError: The episode has no steps, or its rows or frames are missing or too few.
    """
    if row.length == 0:
        raise no_steps_error(f"{info.root}: {row.id}")
    data_file = row.data_file(info)
    if data_file not in files:
        where, needed = f"{storage.join(info.root, data_file)}: {row.id}", f"the {row.length} rows of the episode"
        raise InputError(where=where, found="no such file", needed=needed, fix=FIX_EPISODE)
    for key in keys:
        if f"{key}.file" not in row.locator:
            continue
        video_file = row.video_file(info, key)
        where = f"{storage.join(info.root, video_file)}: {row.id}"
        rows = f"{counted(row.length, 'row')} in {data_file}"
        if video_file not in files:
            raise InputError(
                where=where, found="no such video", needed=f"the frames of {key} for {rows}", fix=FIX_EPISODE
            )
        if not row.lengths_s.get(key, math.inf) > (row.length - 0.5) / info.fps:
            problem = f"{row.lengths_s[key]:.3f} s of video according to the files in meta"
            needed = f"{row.length / info.fps:.3f} s for {rows}"
            raise InputError(where=where, found=problem, needed=needed, fix="Exclude the episode")


def require_video_lengths(
    info: DatasetInfo, row: EpisodeRow, keys: Sequence[str], read_header: Callable[[str], VideoHeader]
) -> None:
    """Refuse an episode whose video ends before its last step according to the header of the video.

    Args:
        info: Description of the data set.
        row: The episode.
        keys: Features of the used cameras.
        read_header: Returns the header of the video at a path.

    Raises:
        InputError: A video is too short, or cannot be read.
    """
    for key in keys:
        if f"{key}.file" in row.locator:
            path = storage.join(info.root, row.video_file(info, key))
            header, last_s = read_header(path), row.locator[f"{key}.start_s"] + (row.length - 1) / info.fps
            if header.num_frames < row.length or header.span_s < last_s - 0.5 / info.fps:
                problem = (
                    f"{header.num_frames} frames at {header.rate_hz:.4g} frames per second, up to {header.span_s:.3f} s"
                )
                needed = f"a frame for each of {row.length} rows at {info.fps:g} rows per second, up to {last_s:.3f} s"
                raise InputError(where=f"{path}: {row.id}", found=problem, needed=needed, fix=FIX_EPISODE)


def find_overlaps(info: DatasetInfo, rows: Sequence[EpisodeRow], keys: Sequence[str]) -> dict[str, InputError]:
    """Return an error for each episode whose time range in a video overlaps that of another episode, by identity.

    Args:
        info: Description of the data set.
        rows: All episodes.
        keys: Features of the used cameras.
    """
    errors: dict[str, InputError] = {}
    for key in keys:
        segments = []
        for row in rows:
            if f"{key}.file" in row.locator:
                start_s = row.locator[f"{key}.start_s"]
                end_s = start_s + row.lengths_s.get(key, row.length / info.fps)
                segments.append((row.video_file(info, key), start_s, end_s, row.id))
        latest = ("", 0.0, 0.0, "")
        for segment in sorted(segments):
            path, start_s, end_s, identity = segment
            end_s = min(end_s, latest[2])
            if path == latest[0] and end_s - start_s > _ROUNDING_STEPS / info.fps:
                seconds = f"{start_s:.6g} to {end_s:.6g} s of {PurePosixPath(path).name}"
                problem, needed = f"{latest[3]} and {identity} both contain {seconds}", "no overlap between episodes"
                error = InputError(where=storage.join(info.root, path), found=problem, needed=needed, fix=_FIX_RANGES)
                errors.setdefault(latest[3], error)
                errors.setdefault(identity, error)
            latest = max(latest, segment, key=lambda item: (item[0], item[2]))
    return errors


def get_row(table: EpisodeTable, index: int) -> EpisodeRow:
    """Return the entry of an episode from the columns of the index, without the task."""
    return EpisodeRow(
        int(table.num_steps[index]), {name: column[index].item() for name, column in table.locators.items()}
    )
