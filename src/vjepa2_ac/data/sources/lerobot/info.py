"""The meta/info.json of a LeRobot data set: version, rate, columns, cameras and file names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from vjepa2_ac import storage
from vjepa2_ac.config import LeRobotData, LeRobotFields
from vjepa2_ac.data.sources.lerobot.features import Feature, feature_of
from vjepa2_ac.data.sources.lerobot.other_forms import FILES, way_from_storage, way_from_version
from vjepa2_ac.data.sources.lerobot.path_templates import require_template
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import read_json_object

INFO = "meta/info.json"
VERSIONS = ("v2.1", "v3.0")

_QUATERNION = (8, "a quaternion's 4")
_STATE_NUMBERS = {"euler_xyz": (7, "3 Euler angles"), "quaternion_wxyz": _QUATERNION, "quaternion_xyzw": _QUATERNION}
_FIX = "Get meta/info.json again"
_WAY_TO_HUB = "Check the name in hf://datasets/owner/name; for a private data set, `hf auth login` or set HF_TOKEN"


@dataclass(frozen=True)
class DatasetInfo:
    """The used part of meta/info.json."""

    root: str
    version: str
    fps: float
    episodes: int
    chunk_episodes: int  # v2.1: episodes per chunk folder
    data_path: str
    video_path: str | None
    features: Mapping[str, Feature]

    @property
    def where(self) -> str:
        """The file."""
        return storage.join(self.root, INFO)

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
                    raise self._missing(f"data.lerobot.{knob}", "column", name, columns)
        _require_state(self, config)
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
            raise self._missing(f"data.lerobot.cameras.{camera}", "camera", key, cameras)
        if self.features[key].dtype == "video" and self.video_path is None:
            raise InputError(where=self.where, found=f"no video_path, and {key} is a video", needed="one", fix=_FIX)
        return key

    def _missing(self, where: str, kind: str, name: str, known: Iterable[str]) -> InputError:
        """Return the error of a name that the data set has not, or has for something else."""
        if name not in self.features:
            return missing(where, kind, name, self.where, known)
        return InputError(
            where=where,
            found=f"{name}, which is {self.features[name].kind} in {self.where}",
            needed="images of a camera" if kind == "camera" else "a column of numbers",
            fix=f"It has: {', '.join(known) or 'none'}",
        )


def missing(where: str, kind: str, name: str, place: str, known: Iterable[str]) -> InputError:
    """Return the error of a missing name, with the existing ones, and a suggestion."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"Did you mean {close[0]}? " if close else ""
    fix = f"{hint}It has: {', '.join(known) or 'none'}"
    return InputError(where=where, found=f"no {kind} {name} in {place}", needed=f"one of its {kind}s", fix=fix)


def read_info(root: str) -> DatasetInfo:
    """Read meta/info.json.

    Raises:
        InputError: There is no data set, it is of another version, or the file is damaged.
        UnreachableError: It cannot be read.
    """
    where = storage.join(root, INFO)
    try:
        content = read_json_object(where, needed="a description of a data set", fix=_FIX)
    except (FileNotFoundError, NotADirectoryError):
        fix = _WAY_TO_HUB if root.startswith("hf://") else "Set data.path to the folder with meta, data and videos"
        found = f"no {INFO} in {root}"
        raise InputError(where="data.path", found=found, needed="a LeRobot data set", fix=fix) from None
    except OSError as error:
        raise storage.unreadable(where, error) from None
    if (version := content.get("codebase_version")) not in VERSIONS:
        found, fix = f"codebase_version {version!r}", way_from_version(version)
        raise InputError(where=where, found=found, needed=" or ".join(VERSIONS), fix=fix)
    if (stored_as := content.get("storage_format") or FILES) != FILES:
        found, fix = f"storage_format {stored_as!r}", way_from_storage(stored_as)
        raise InputError(where=where, found=found, needed="Parquet files and MP4 videos", fix=fix)
    try:
        return _parsed(root, where, content)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        found = f"not a description of a data set ({error!r})"
        raise InputError(where=where, found=found, needed="LeRobot's own", fix=_FIX) from None


def _parsed(root: str, where: str, content: Mapping[str, Any]) -> DatasetInfo:
    video_path = content.get("video_path")
    fps, episodes, chunk = float(content["fps"]), content["total_episodes"], content.get("chunks_size", 1000)
    if not 0 < fps <= 1000 or type(episodes) is not int or type(chunk) is not int or episodes < 0 or chunk < 1:
        raise ValueError(f"fps {fps}, total_episodes {episodes}, chunks_size {chunk}")
    return DatasetInfo(
        root=root,
        version=content["codebase_version"],
        fps=fps,
        episodes=episodes,
        chunk_episodes=chunk,
        data_path=require_template(content["data_path"], f"{where}: data_path"),
        video_path=None if video_path is None else require_template(video_path, f"{where}: video_path"),
        features={name: feature_of(feature) for name, feature in content["features"].items()},
    )


def _require_state(info: DatasetInfo, config: LeRobotData) -> None:
    fields = config.lerobot
    described = " + ".join(_described(name, info.features[name]) for name in fields.state)
    where = "data.lerobot.select" if fields.select is not None else "data.lerobot.state"
    joined = sum(info.features[name].width for name in fields.state)
    if fields.select is not None and (beyond := [number for number in fields.select if number >= joined]):
        found = f"{beyond[0]}, of {joined} numbers in {described}"
        raise InputError(where=where, found=found, needed=f"0 to {joined - 1}")
    width, (needed, rotation) = len(fields.select or range(joined)), _STATE_NUMBERS[fields.rotation]
    if config.states == "pose" and width != needed:
        raise InputError(
            where=where,
            found=f"{width} numbers a step from {described}",
            needed=f"{needed}: x, y, z, {rotation} (data.lerobot.rotation: {fields.rotation}), the gripper",
            fix="Name other columns in data.lerobot.state, or choose among their numbers with data.lerobot.select",
        )


def _described(name: str, feature: Feature) -> str:
    return f"{name} [{', '.join(feature.names) if len(feature.names) == feature.width else feature.width}]"
