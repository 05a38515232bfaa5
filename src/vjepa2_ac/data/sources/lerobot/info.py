"""The meta/info.json of a LeRobot data set: version, rate, columns, cameras and file names."""

from __future__ import annotations

import glob
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

from vjepa2_ac import storage
from vjepa2_ac.config import LeRobotData, LeRobotFields
from vjepa2_ac.data.files import in_parallel
from vjepa2_ac.data.poses import require_selection
from vjepa2_ac.errors import InputError, MissingFileError, did_you_mean
from vjepa2_ac.media.video import is_deep_grey
from vjepa2_ac.storage import FileInfo
from vjepa2_ac.storage.structured import read_json_object

INFO = "meta/info.json"
VERSIONS = ("v2.1", "v3.0")

_PLACE = re.compile(r"\{(?:(video_key)|(?:chunk_index|file_index|episode_chunk|episode_index)(?::0\dd)?)\}")
_FIX = "Get meta/info.json again"
_FIX_VERSION = (
    "lerobot 0.3.3's convert_dataset_v1_to_v2.py and convert_dataset_v20_to_v21.py make v2.1 of older ones; for newer "
    "ones update vjepa2-ac"
)
_FIX_STORAGE = "`vjepa2-ac data converter lance_to_files` prints a script that writes the files a Lance table is of"
_WAY_TO_HUB = "Check the name in hf://datasets/owner/name; for a private data set, `hf auth login` or set HF_TOKEN"


@dataclass(frozen=True)
class Feature:
    """One column, or one camera."""

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] = ()
    is_depth: bool = field(default=False, repr=False)  # not in the key of stored indexes

    @property
    def width(self) -> int:
        """Its width: numbers per step."""
        return math.prod(self.shape)

    @property
    def is_camera(self) -> bool:
        """Whether it contains frames that show what a camera saw."""
        return self.dtype in {"video", "image"} and not self.is_depth

    @property
    def is_numbers(self) -> bool:
        """Whether it is a column of numbers."""
        return self.dtype.startswith(("float", "int", "uint", "bool"))


@dataclass(frozen=True)
class DatasetInfo:
    """The used part of meta/info.json."""

    root: str
    version: str
    fps: float
    episodes: int
    frames: int | None  # of all episodes; None: not said
    chunk_episodes: int  # v2.1: episodes per chunk folder
    data_path: str
    video_path: str | None
    features: Mapping[str, Feature]
    splits: Mapping[str, range] = field(default_factory=dict, repr=False)  # not in the key of stored indexes

    @property
    def where(self) -> str:
        """The file."""
        return storage.join(self.root, INFO)

    def split_of(self, episode: int) -> str | None:
        """Return the name of the split of an episode, given by its number; None: no split has it."""
        return next((name for name, episodes in self.splits.items() if episode in episodes), None)

    def require_mapping(self, config: LeRobotData) -> None:
        """Check that the data set has what `data.lerobot` and `data.camera` name, before anything large is read.

        Raises:
            InputError: A column or camera is missing (lists the existing ones), or they do not form a state.
        """
        fields = config.lerobot
        columns = [name for name, feature in self.features.items() if feature.is_numbers]
        wanted = {"state": fields.state, "action": fields.action if config.actions == "recorded" else ()}
        for knob, names in wanted.items():
            for name in names:
                if name not in columns:
                    raise missing(f"data.lerobot.{knob}", "column of numbers", name, self.where, columns)
        self._require_state(config)
        for camera in config.cameras:
            self.camera_key(fields, camera)

    def camera_key(self, fields: LeRobotFields, camera: str) -> str:
        """Return the feature with a camera's frames.

        Raises:
            InputError: The config or the data set has no such camera.
        """
        if camera not in fields.cameras:
            raise missing("data.camera", "camera", camera, "data.lerobot.cameras", fields.cameras)
        key = fields.cameras[camera]
        cameras = [name for name, feature in self.features.items() if feature.is_camera]
        if key not in cameras:
            raise missing(f"data.lerobot.cameras.{camera}", "camera", key, self.where, cameras)
        if self.features[key].dtype == "video" and self.video_path is None:
            raise InputError(where=self.where, found=f"no video_path, and {key} is a video", needed="one", fix=_FIX)
        return key

    def _require_state(self, config: LeRobotData) -> None:
        columns = {}
        for name in config.lerobot.state:
            feature = self.features[name]
            described = ", ".join(feature.names) if len(feature.names) == feature.width else feature.width
            columns[f"{name} [{described}]"] = feature.width
        require_selection(columns, config.lerobot, "data.lerobot", is_pose=config.states == "pose")


def missing(where: str, kind: str, name: str, place: str, known: Iterable[str]) -> InputError:
    """Return the error of a missing name, with the existing ones, and a suggestion."""
    known = list(known)
    fix = f"{did_you_mean(name, known)}It has: {', '.join(known) or 'none'}"
    return InputError(where=where, found=f"no {kind} {name} in {place}", needed="one that it has", fix=fix)


def read_info(root: str) -> DatasetInfo:
    """Read meta/info.json.

    Raises:
        InputError: There is no data set, it is of another version, or the file is damaged.
        UnreachableError: It cannot be read.
    """
    where = storage.join(root, INFO)
    try:
        content = read_json_object(where, needed="a description of a data set", fix=_FIX)
    except MissingFileError:
        fix = _WAY_TO_HUB if root.startswith("hf://") else "Set data.path to the folder with meta, data and videos"
        found = f"no {INFO} in {root}"
        raise InputError(where="data.path", found=found, needed="a LeRobot data set", fix=fix) from None
    if (version := content.get("codebase_version")) not in VERSIONS:
        found = f"codebase_version {version!r}"
        raise InputError(where=where, found=found, needed=" or ".join(VERSIONS), fix=_FIX_VERSION)
    if (stored_as := content.get("storage_format") or "parquet") != "parquet":
        found = f"storage_format {stored_as!r}"
        raise InputError(where=where, found=found, needed="Parquet files and MP4 videos", fix=_FIX_STORAGE)
    try:
        return _parsed(root, content)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        found = f"not a description of a data set ({error!r})"
        raise InputError(where=where, found=found, needed="LeRobot's own", fix=_FIX) from None


def _parsed(root: str, content: Mapping[str, Any]) -> DatasetInfo:
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
        data_path=_template(content["data_path"]),
        video_path=None if video_path is None else _template(video_path),
        features={name: _feature(feature) for name, feature in content["features"].items()},
        splits=_splits(content.get("splits")),
    )


def _splits(content: object) -> dict[str, range]:
    """Return the episodes of each split, from {"train": "0:50"}; other notations are ignored."""
    texts = content if isinstance(content, Mapping) else {}
    ranges = {str(name): re.fullmatch(r"(\d{1,9}):(\d{1,9})", str(text)) for name, text in texts.items()}
    return {name: range(int(part[1]), int(part[2])) for name, part in ranges.items() if part}


def _feature(content: Mapping[str, Any]) -> Feature:
    """Return a feature; a depth map is marked in one of the ways of LeRobot's versions, or by its pixels.

    Source: huggingface/lerobot @ 7427f31, src/lerobot/configs/video.py, is_depth_map.
    """
    dtype, shape, names = content["dtype"], tuple(content["shape"]), content.get("names")
    if not isinstance(dtype, str) or not all(type(size) is int and size > 0 for size in shape):
        raise TypeError(f"a feature of dtype {dtype!r} and shape {shape!r}")
    if isinstance(names, dict) and all(type(index) is int for index in names.values()):  # {"x": 0, "y": 1, ...}
        names = sorted(names, key=names.__getitem__)
    elif isinstance(names, dict) and len(names) == 1:  # {"motors": ["x", "y", ...]}, as in older ports
        names = next(iter(names.values()))
    marks = [one for one in (content.get("info"), content.get("video_info")) if isinstance(one, Mapping)]
    is_depth = any(
        one.get("is_depth_map") or one.get("video.is_depth_map") or is_deep_grey(str(one.get("video.pix_fmt")))
        for one in marks
    )
    return Feature(dtype, shape, tuple(map(str, names)) if isinstance(names, list) else (), is_depth)


def _template(template: str) -> str:
    """Return a path template such as `chunk-{chunk_index:03d}`, which must not lead out of the data set."""
    rest = _PLACE.sub("", template)
    if not template or template.startswith("/") or ".." in template.split("/") or "{" in rest or "}" in rest:
        raise ValueError(f"the path template {template!r}")
    return template


def filled(template: str, chunk: int, file: int, key: str = "") -> str:
    """Return the path, within the data set, of a file: in v3.0 by chunk and file, in v2.1 by chunk and episode."""
    return template.format(chunk_index=chunk, episode_chunk=chunk, file_index=file, episode_index=file, video_key=key)


def list_by_template(root: str, template: str, key: str = "", *, connections: int = 1) -> dict[str, FileInfo]:
    """Return the files whose paths fit a template, sorted by path within the data set.

    Raises:
        InputError: One of them is a git-lfs pointer.
        OSError: A folder cannot be listed.
    """
    pattern = _PLACE.sub(lambda place: glob.escape(key) if place[1] else "[0-9]*", template)
    *folders, name = pattern.split("/")
    found = [""]
    for part in folders:
        names = {folder: storage.list_names(storage.join(root, folder)) if "[" in part else [part] for folder in found}
        found = [f"{folder}{one}/" for folder in found for one in names[folder] if fnmatchcase(one, part)]
    listings = in_parallel(lambda folder: storage.list_files(storage.join(root, folder)), found, connections)
    files = [(folder, file) for folder, inside in zip(found, listings, strict=True) for file in inside]
    fitting = dict(sorted((f"{folder}{file.name}", file) for folder, file in files if fnmatchcase(file.name, name)))
    for path, file in fitting.items():
        storage.require_content(storage.join(root, path), file.size)
    return fitting
