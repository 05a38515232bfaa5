"""Source of DROID's raw recordings: states from HDF5, frames from MP4, names from JSON.

The tree is LAB/success|failure/DATE/TIME/{trajectory.h5, metadata_*.json, recordings/MP4/*.mp4}.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import RawDroidData
from vjepa2_ac.config.sources import RAW_CAMERAS, RAW_RATE_HZ
from vjepa2_ac.data.files import CONNECTIONS, MAX_DEPTH, list_folder, map_in_threads
from vjepa2_ac.data.index import EpisodeTable, get_or_build_index, hash_key, index_key, summarize_states
from vjepa2_ac.data.sources.indexed_source import IndexedSource, IndexEntry, make_frame_reader, require_indexed_length
from vjepa2_ac.episode import Episode, EpisodeInfo, Progress, StepRanges
from vjepa2_ac.errors import InputError, counted, did_you_mean, require_library
from vjepa2_ac.media.video import read_frame_times, read_frames, read_header
from vjepa2_ac.spaces import POSE, require_finite
from vjepa2_ac.storage import FileInfo
from vjepa2_ac.storage.structured import parse_json_object

TRAJECTORY = "trajectory.h5"
VIDEOS = "recordings/MP4"

_OUTCOMES = ("success", "failure")
_FIX = "Copy the episode again"
_MAX_STEPS = 1_000_000  # limit, because a damaged header may state any number
_REQUIRED = {
    "pose": ("observation/robot_state/cartesian_position", 6),
    "gripper": ("observation/robot_state/gripper_position", 1),
}
_OPTIONAL = {
    "skipped": ("observation/timestamp/skip_action", 1),  # the operator was not in control
    "velocities": ("action/joint_velocity", 7),  # commanded joint velocities
}

Arrays = Mapping[str, Shaped[np.ndarray, "steps *numbers"]]  # pose, gripper, ... per control step


@dataclass(frozen=True)
class _EpisodeLocation:
    """The location of an episode, with facts from the metadata and the videos."""

    folder: str  # relative to the data set's folder
    version: str
    serials: dict[str, str]  # serial number of each camera in the metadata
    frames: dict[str, int]  # number of frames in the MP4 of each of the config's cameras, by serial number


class RawDroidSource(IndexedSource[RawDroidData, None]):
    """The episodes of a raw DROID tree, or of a part of it, in the order of their paths.

    `infos` reads every trajectory and the headers of the MP4s of the config's cameras once. Data behind a URL is not
    checked again until folders are added or removed. An episode's identity is LAB/outcome/DATE/TIME
    (`get_identity`). The numbers of a trajectory and the times of a video's frames are stored in the disk cache, so
    that each machine parses the HDF5 file and reads the packets of a video with B-frames only once.

    An MP4 has one frame per control step, in order; only the last frame may be missing. The rate in its header is not
    used.
    """

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - a video is fetched in blocks
        """Return an episode; only requested frames are decoded.

        Raises:
            InputError: A file is missing or damaged, or has changed since it was indexed.
            OSError: Data behind a URL cannot be read.
        """
        table = self.infos()
        info = table[index]
        location = _EpisodeLocation(**parse_json_object(table.locators["place"][index].decode(), where="the index"))
        serial = _select_serial(location.serials, camera or self._config.cameras[0], info.id)
        numbers = self._read_arrays(location, (serial,))
        states = _join_states(numbers)
        require_indexed_length(len(states), info, self._path(location.folder, TRAJECTORY))
        video = self._path(location.folder, f"{VIDEOS}/{serial}.mp4")
        task = table.label("task", index)
        frames = partial(self._read_frames, video, location.version, numbers["frame"].tolist())
        return Episode(
            info=info,
            states=states,
            read_frames=make_frame_reader(info.num_steps, video, frames),
            control_rate_hz=RAW_RATE_HZ,
            extrinsics=numbers.get(serial),
            joint_velocities=numbers.get("velocities"),
            metadata={} if task is None else {"language": task},
        )

    def _read_frames(
        self, video: str, version: str, frames: Sequence[int], steps: Sequence[int]
    ) -> UInt8[np.ndarray, "time height width 3"]:
        open_video = partial(self._files.open, video, version=version)
        read_times = lambda: {"times": np.array(read_frame_times(open_video(), where=video), np.int64)}  # noqa: E731
        times = self._files.read_parsed(f"times {video} {version}", read_times)["times"].tolist()
        return read_frames(open_video(), [frames[step] for step in steps], where=video, times=times)

    def _open_data_set(self, progress: Progress) -> tuple[EpisodeTable, None]:
        """Return the cached table, or scan all episodes; a changed local file changes the key."""
        config, root = self._config, self._config.path
        folders = find_episodes(root, CONNECTIONS)
        if not folders:
            needed = f"folders LAB/success|failure/DATE/TIME with a {TRAJECTORY}"
            fix = "The raw DROID recordings are in gs://gresearch/robotics/droid_raw/1.0.1"
            raise InputError(where="data.path", found=f"no episodes under {root}", needed=needed, fix=fix)
        episode_files: Sequence[EpisodeFolder | str] = folders
        if not storage.is_url(root):
            episode_files = [list_episode(root, folder) for folder in folders]
        parts = {
            "source": "droid_raw",
            "cameras": config.cameras,
            **config.format_values,
            "pose_frame": config.pose_frame,
            "folders": episode_files,
        }
        key = index_key(parts, root, identity=get_identity(root, folders[0]))
        identities = {folder: get_identity(root, folder) for folder in folders}
        build = partial(self._scan_all, self._scan, identities, progress)
        return get_or_build_index(config.disk_cache, key, root, build), None

    def _scan(self, folder: str) -> IndexEntry:
        identity = get_identity(self._config.path, folder)
        episode_files = list_episode(self._config.path, folder)
        has_trajectory = any(file.name == TRAJECTORY for file in episode_files.files)
        if not has_trajectory or episode_files.metadata is None:
            file = "metadata_*.json" if has_trajectory else TRAJECTORY
            problem, needed = f"episode {identity} has no {file}", f"a {file} in each episode"
            raise InputError(where=self._path(folder, ""), found=problem, needed=needed, fix=_FIX)
        version, path = hash_key({"files": episode_files}), self._path(folder, episode_files.metadata)
        metadata = parse_json_object(
            self._files.read(path, version=version), where=path, needed="the metadata of an episode"
        )
        all_serials = {camera: _parse_serial(metadata, camera) for camera in RAW_CAMERAS}
        serial_by_camera = {camera: serial for camera, serial in all_serials.items() if serial}
        serials = tuple(_select_serial(serial_by_camera, camera, path) for camera in self._config.cameras)
        counts = {}
        for serial in serials:
            video = self._path(folder, f"{VIDEOS}/{serial}.mp4")
            names = [file.name for file in episode_files.videos]
            if f"{serial}.mp4" not in names:
                problem = f"no such file; existing MP4 files: {', '.join(names) or 'none'}"
                needed = f"the MP4 of a camera in {episode_files.metadata} or data.camera"
                fix = f"{did_you_mean(serial, [*RAW_CAMERAS, *serial_by_camera.values()])}{_FIX}"
                raise InputError(where=video, found=problem, needed=needed, fix=fix)
            counts[serial] = read_header(video, where=video).num_frames
        location = _EpisodeLocation(folder, version, serial_by_camera, counts)
        states = _join_states(self._read_arrays(location, serials))
        success = metadata.get("success")
        outcome = success if isinstance(success, bool) else parse_outcome(identity)
        return IndexEntry(
            EpisodeInfo(identity, len(states), outcome),
            self._path(folder, TRAJECTORY),
            locator={"place": json.dumps(vars(location)).encode()},
            states=summarize_states(states),
            labels=_parse_labels(metadata),
            rate_hz=RAW_RATE_HZ,
        )

    def _read_arrays(self, location: _EpisodeLocation, serials: tuple[str, ...]) -> Arrays:
        """Return the arrays of the steps in which the operator was in control, and the frame index of each step.

        Raises:
            InputError: The trajectory is damaged, incomplete, implausible, or of another length than an MP4.
        """
        path = self._path(location.folder, TRAJECTORY)
        key = f"trajectory {path} {location.version} {serials}"
        read = partial(self._files.read, path, version=location.version)
        arrays = self._files.read_parsed(key, lambda: parse_trajectory(read(), path, serials))
        steps = len(arrays["pose"])
        for serial, count in location.frames.items():
            if abs(steps - count) > 1:
                problem = f"{counted(steps, 'step')}, but {counted(count, 'frame')} in {serial}.mp4"
                needed = "one frame for each step; only the last frame may be missing"
                raise InputError(where=path, found=problem, needed=needed, fix=_FIX)
        if self._config.pose_frame == "camera" and not arrays.keys() >= set(serials):
            needed = "the array observation/camera_extrinsics for each camera of data.camera"
            raise InputError(
                where=path, found="the camera poses are missing", needed=needed, fix="Set data.pose_frame: base"
            )
        used_steps = np.arange(min(steps, *location.frames.values()))
        if "skipped" in arrays:
            used_steps = used_steps[arrays["skipped"][used_steps, 0] == 0]
        numbers = {name: values[used_steps] for name, values in arrays.items()} | {"frame": used_steps}
        POSE.require_plausible(_join_states(numbers), path, fix=_FIX)
        return numbers

    def _path(self, folder: str, name: str) -> str:
        return storage.join(storage.join(self._config.path, folder), name)


def parse_trajectory(data: bytes, where: str, serials: Sequence[str]) -> dict[str, Float[np.ndarray, "steps _"]]:
    """Parse a trajectory.h5 into arrays per step: pose, gripper, and if present skipped, velocities, camera poses.

    Args:
        data: The content of the file.
        where: The file, for messages.
        serials: Serial numbers of cameras; the poses of a camera are returned under its serial number.

    Raises:
        InputError: The file is not HDF5, damaged or incomplete.
    """
    h5py = require_library("h5py", where=where, called="h5py, which reads trajectory.h5", extra="raw")
    poses = {serial: (f"observation/camera_extrinsics/{serial}_left", 6) for serial in serials}
    arrays: dict[str, Float[np.ndarray, "steps _"]] = {}
    try:
        # Read from memory, so that HDF5 never waits for a network or crashes on a file that is being truncated.
        with h5py.File(h5py.h5f.open_file_image(data)) as file:
            for name, (array_path, width) in (_REQUIRED | _OPTIONAL | poses).items():
                if array_path in file:
                    arrays[name] = _read_array(file[array_path], width, f"{where}: {array_path}")
                elif name in _REQUIRED:
                    problem = f"no such array; {_describe_nearest_group(file, array_path)}"
                    raise InputError(where=f"{where}: {array_path}", found=problem, fix=_FIX)
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, MemoryError, OverflowError) as error:
        problem = f"{len(data)} bytes that cannot be read as HDF5 ({str(error)[:200]})"
        raise InputError(where=where, found=problem, needed="an undamaged trajectory.h5", fix=_FIX) from None
    steps = len(arrays["pose"])
    for name, values in arrays.items():
        if len(values) != steps:
            raise InputError(
                where=f"{where}: {name}", found=f"values for {len(values)} of {counted(steps, 'step')}", fix=_FIX
            )
    return arrays


def _describe_nearest_group(file: Any, array_path: str) -> str:
    """Return the names in the deepest existing group of the path of a missing array, for a message."""
    parents = [str(parent) for parent in PurePosixPath(array_path).parents]
    group = next((parent for parent in parents if isinstance(file.get(parent), type(file["/"]))), "/")
    name = f"group {group}" if group in parents[:-1] else "the file"
    return f"{name} contains {', '.join(sorted(file[group]))[:200] or 'nothing'}"


def _read_array(data: Any, width: int, where: str) -> Float[np.ndarray, "steps width"]:
    """Read an HDF5 array of `width` finite numbers per step; for width 1 the second axis may be missing."""
    shape, kind = tuple(getattr(data, "shape", None) or ()), getattr(getattr(data, "dtype", None), "kind", "?")
    has_width = shape[1:] == (width,) or (width == 1 and len(shape) == 1)
    if not has_width or shape[0] > _MAX_STEPS or kind not in "fiub":
        problem, needed = f"shape {shape} of dtype kind {kind!r}", f"{width} numbers for each step"
        raise InputError(where=where, found=problem, needed=needed, fix=_FIX)
    values = np.asarray(data[()], dtype=np.float64).reshape(-1, width)
    require_finite(values, where, fix=_FIX)
    return values


def _join_states(numbers: Arrays) -> Float[np.ndarray, "steps 7"]:
    return np.concatenate([numbers["pose"], numbers["gripper"]], axis=1)


def _parse_serial(metadata: Mapping[str, Any], camera: str) -> str | None:
    """Return the serial number of a camera, from the name of its MP4 in the metadata; None if it is missing."""
    path = metadata.get(f"{camera}_mp4_path")
    name = PurePosixPath(path).name if isinstance(path, str) else ""
    return name.removesuffix(".mp4") if name.endswith(".mp4") else None


def _select_serial(serials: Mapping[str, str], camera: str, where: str) -> str:
    """Return the serial number of a camera, given by a name (left, right, wrist, ext1, ext2) or a serial number."""
    if camera in RAW_CAMERAS and camera not in serials:
        problem, fix = f"{camera}_mp4_path is missing or not an MP4", "Set data.camera to a camera of every episode"
        raise InputError(where=where, found=problem, needed="the path of an MP4 in the metadata", fix=fix)
    return serials.get(camera, camera)


def _parse_labels(metadata: Mapping[str, Any]) -> dict[str, str | None]:
    """Return the labels scene, building, operator and task of an episode; None where unknown."""
    texts = {key: str(value) for key, value in metadata.items() if isinstance(value, str | int)}
    return {
        "scene": texts.get("scene_id"),
        "building": texts.get("building"),
        "operator": texts.get("user_id", texts.get("user")),
        "task": texts.get("current_task"),
    }


# ---- the folders of episodes ----


@dataclass(frozen=True)
class EpisodeFolder:
    """The listing of an episode's folder."""

    path: str  # relative to the data set's folder; "" is the data set's folder itself
    files: tuple[FileInfo, ...]
    videos: tuple[FileInfo, ...]

    @property
    def metadata(self) -> str | None:
        """The name of the metadata file, or None; DROID's upload wrote this file last, for complete episodes only."""
        return next((file.name for file in self.files if _is_metadata(file.name)), None)


def find_episodes(root: str, connections: int) -> list[str]:
    """Return the folders of all episodes, relative to `root`, sorted; [""] if `root` itself is an episode.

    Raises:
        OSError: A folder cannot be listed.
    """
    if _is_episode(root, ""):
        return [""]
    episodes: list[str] = []
    folders = [""]
    for _ in range(MAX_DEPTH):
        listings = map_in_threads(lambda folder: _list_children(root, folder), folders, connections)
        children = [child for listing in listings for child in listing]
        episodes += [path for path, is_episode in children if is_episode]
        folders = [path for path, is_episode in children if not is_episode]
    return sorted(episodes)


def list_episode(root: str, folder: str) -> EpisodeFolder:
    """List the files of one episode.

    Raises:
        OSError: A folder cannot be listed.
    """
    path = storage.join(root, folder)
    videos = storage.list_files(storage.join(path, VIDEOS))
    return EpisodeFolder(folder, tuple(storage.list_files(path)), tuple(videos))


def get_identity(root: str, folder: str) -> str:
    """Return the identity of an episode: LAB/outcome/DATE/TIME if its full path has this form, else its relative path.

    LAB/outcome/DATE/TIME does not depend on which folder of the tree is `root`.
    """
    base = root.split("://", 1)[1] if storage.is_url(root) else str(Path(root).resolve())
    parts = [part for part in f"{base}/{folder}".split("/") if part]
    return "/".join(parts[-4:]) if _has_droid_layout(parts) else folder or parts[-1]


def parse_outcome(identity: str) -> bool | None:
    """Return whether the episode succeeded according to its identity, or None."""
    parts = identity.split("/")
    return parts[-3] == "success" if _has_droid_layout(parts) else None


def _list_children(root: str, folder: str) -> list[tuple[str, bool]]:
    """Return (path, whether it is an episode) of the folders in a folder.

    In DROID's layout the depth of a path identifies episodes, so that their folders need not be listed.
    """
    children = [storage.join(folder, name) for name in list_folder(root, folder)[1]]
    return [(path, parse_outcome(get_identity(root, path)) is not None or _is_episode(root, path)) for path in children]


def _has_droid_layout(parts: Sequence[str]) -> bool:
    return len(parts) >= 4 and parts[-3] in _OUTCOMES


def _is_episode(root: str, folder: str) -> bool:
    names = storage.list_names(storage.join(root, folder))
    return any(name == TRAJECTORY or _is_metadata(name) for name in names)


def _is_metadata(name: str) -> bool:
    return name.startswith("metadata") and name.endswith(".json")
