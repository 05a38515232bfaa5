"""Source of DROID's raw recordings: states from HDF5, frames from MP4, names from JSON."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int, UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import RawDroidData
from vjepa2_ac.config.effects import Affects, knobs_that_affect
from vjepa2_ac.data.cache.cached_reads import EpisodeFiles
from vjepa2_ac.data.filters.broken_episodes import as_error, as_problem
from vjepa2_ac.data.index.episode_table import EpisodeProblem, EpisodeTable
from vjepa2_ac.data.index.index_cache import IndexKeys, get_or_build, key_of
from vjepa2_ac.data.index.labels import labels_of
from vjepa2_ac.data.index.packed_text import pack_texts, text_of
from vjepa2_ac.data.index.state_hash import hash_of_states
from vjepa2_ac.data.sources.droid_raw.episode_folders import (
    TRAJECTORY,
    VIDEOS,
    EpisodeFolder,
    find_episodes,
    identity_of,
    list_episode,
    success_of,
)
from vjepa2_ac.data.sources.droid_raw.metadata import DroidMetadata
from vjepa2_ac.data.sources.droid_raw.trajectory import Trajectory, parse_trajectory
from vjepa2_ac.data.sources.listing import in_parallel
from vjepa2_ac.episode import Episode, EpisodeInfo, Progress, StepRanges
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.video_reader import count_frames, read_frames
from vjepa2_ac.spaces import POSE
from vjepa2_ac.storage.structured import json_object

logger = logging.getLogger(__name__)

_FIX = "Copy the episode again"


@dataclass(frozen=True)
class _Place:
    """Location of an episode, and the inputs of its index entry."""

    folder: str
    metadata: str
    version: str
    pictures: dict[str, int]  # number of frames of each of the config's cameras, by serial number


@dataclass(frozen=True)
class _Found:
    """An episode that can be used."""

    info: EpisodeInfo
    place: _Place
    state_hash: int
    labels: dict[str, str | None]


class RawDroidSource:
    """The episodes of a raw DROID tree, or of a part of it, in the order of their paths.

    Nothing is read before the first call. `infos` reads every trajectory and the headers of the MP4s of the config's
    cameras, once; data behind a URL is not checked again until folders are added or removed. An episode's identity is
    LAB/outcome/DATE/TIME (`episode_folders.identity_of`).

    An MP4 holds one frame per control step, in order, whatever rate its header states, and may lack the last step's.
    """

    def __init__(self, config: RawDroidData) -> None:
        self._config = config
        self._root = config.path
        self._files = EpisodeFiles(config)
        self._table: EpisodeTable | None = None

    def infos(self, progress: Progress | None = None) -> EpisodeTable:
        """Return identity, length and outcome of every usable episode.

        Raises:
            InputError: There are no episodes, or none can be used.
            OSError: Data behind a URL cannot be read.
        """
        if self._table is None:
            self._table = self._indexed(progress)
        return self._table

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - a video is fetched in blocks
        """Return one episode; only requested frames are decoded.

        Raises:
            InputError: A file is missing or damaged, or has changed since it was indexed.
            OSError: Data behind a URL cannot be read.
        """
        table = self.infos()
        info, place = table[index], _Place(**json_object(text_of("place", table.locators, index), where="the index"))
        metadata = self._metadata(place)
        serial = metadata.serial(camera or self._config.cameras[0])
        trajectory = self._trajectory(place, (serial,))
        if len(trajectory.states) != info.num_steps:
            raise InputError(
                where=self._path(place, TRAJECTORY),
                found=f"{len(trajectory.states)} steps",
                needed=f"the {info.num_steps} that were indexed",
                fix="Do not change files while a run reads them",
            )
        video = self._path(place, f"{VIDEOS}/{serial}.mp4")
        return Episode(
            info=info,
            states=trajectory.states,
            read_frames=_VideoReader(video, place.version, trajectory.frame_places, self._files),
            control_rate_hz=self._config.droid_raw.control_rate_hz,
            extrinsics=trajectory.extrinsics[serial],
            joint_velocities=trajectory.joint_velocities,
            metadata={} if metadata.language is None else {"language": metadata.language},
        )

    def _indexed(self, progress: Progress | None) -> EpisodeTable:
        """Return the cached table, or scan every episode; a changed local file changes the key."""
        config = self._config
        folders = find_episodes(self._root, config.connections)
        if not folders:
            raise InputError(
                where="data.path",
                found=f"no episodes under {self._root}",
                needed=f"folders LAB/success|failure/DATE/TIME with a {TRAJECTORY}",
                fix="DROID's are in gs://gresearch/robotics/droid_raw/1.0.1",
            )
        listed: Sequence[EpisodeFolder | str] = folders
        if not storage.is_url(self._root):
            listed = [list_episode(self._root, folder) for folder in folders]
        own = knobs_that_affect(Affects.INDEX, config.droid_raw)
        keys = IndexKeys.of(
            {
                "source": "droid_raw",
                "cameras": config.cameras,
                "droid_raw": " ".join(f"{name}={value!r}" for name, value in own.items()),
                "pose_frame": config.pose_frame,
                "listed": listed,
            },
            self._root,
            named=identity_of(self._root, folders[0]),
        )
        return get_or_build(config.disk_cache, keys, self._root, lambda: self._scan_all(folders, progress))

    def _scan_all(self, folders: list[str], progress: Progress | None) -> EpisodeTable:
        done = 0

        def scan(folder: str) -> _Found | EpisodeProblem:
            nonlocal done
            found = self._scan(folder)
            done += 1
            if progress is not None:
                progress(done, len(folders))
            return found

        usable: dict[str, _Found] = {}
        problems = []
        for found in in_parallel(scan, folders, self._config.connections if storage.is_url(self._root) else 1):
            if isinstance(found, EpisodeProblem):
                problems.append(found)
            elif found.info.id in usable:
                problems.append(_twice(found.info.id, self._path(found.place, TRAJECTORY)))
            else:
                usable[found.info.id] = found
        if not usable:
            raise as_error(problems[0])
        texts = {"control_rate_hz": str(self._config.droid_raw.control_rate_hz)}
        logger.info("%s: %d episodes, %d that cannot be used", self._root, len(usable), len(problems))
        return EpisodeTable.of(
            [one.info for one in usable.values()],
            problems=problems,
            locators=pack_texts("place", [json.dumps(vars(one.place)) for one in usable.values()]),
            texts=texts,
            state_hashes=[one.state_hash for one in usable.values()],
            labels=labels_of([one.labels for one in usable.values()]),
        )

    def _scan(self, folder: str) -> _Found | EpisodeProblem:
        identity = identity_of(self._root, folder)
        listed = list_episode(self._root, folder)
        try:
            place = self._place_of(listed, identity)
            metadata = self._metadata(place)
            serials = tuple(metadata.serial(camera) for camera in self._config.cameras)
            place = replace(place, pictures=self._counted(place, listed, serials))
            states = self._trajectory(place, serials).states
        except InputError as error:
            return as_problem(error, identity)
        success = success_of(identity) if metadata.success is None else metadata.success
        info = EpisodeInfo(identity, len(states), success)
        return _Found(info, place, hash_of_states(states), metadata.labels)

    def _place_of(self, listed: EpisodeFolder, identity: str) -> _Place:
        if not listed.has_trajectory or listed.metadata is None:
            missing = TRAJECTORY if not listed.has_trajectory else "metadata_*.json"
            where = self._path(listed.path, "")
            raise InputError(where=where, found=f"episode {identity} has no {missing}", needed="one", fix=_FIX)
        return _Place(listed.path, listed.metadata, key_of({"files": listed}), {})

    def _counted(self, place: _Place, listed: EpisodeFolder, serials: tuple[str, ...]) -> dict[str, int]:
        """Return the number of frames of each camera."""
        counts = {}
        for serial in serials:
            path = self._path(place, f"{VIDEOS}/{serial}.mp4")
            if not any(video.name == f"{serial}.mp4" for video in listed.videos):
                there = ", ".join(video.name for video in listed.videos) or "none"
                needed = f"the MP4 that {place.metadata} or data.camera names; there are {there}"
                raise InputError(where=path, found="no such file", needed=needed, fix=_FIX)
            counts[serial] = count_frames(path, where=path)
        return counts

    def _metadata(self, place: _Place) -> DroidMetadata:
        path = self._path(place, place.metadata)
        return DroidMetadata.parse(self._files.read(path, version=place.version, where=path), path)

    def _trajectory(self, place: _Place, serials: tuple[str, ...]) -> Trajectory:
        path = self._path(place, TRAJECTORY)
        data = self._files.read(path, version=place.version, where=path)
        trajectory = parse_trajectory(data, where=path, serials=serials, frame_counts=place.pictures)
        if self._config.pose_frame == "camera" and any(trajectory.extrinsics[serial] is None for serial in serials):
            needed = "observation/camera_extrinsics of the camera"
            raise InputError(where=path, found="no poses of the camera", needed=needed, fix="Set data.pose_frame: base")
        if self._config.droid_raw.skip_action == "drop":
            trajectory = trajectory.at(np.flatnonzero(~trajectory.skipped))
        POSE.require_plausible(trajectory.states, path, fix=_FIX)
        return trajectory

    def _path(self, place: _Place | str, name: str) -> str:
        folder = place if isinstance(place, str) else place.folder
        path = storage.join(self._root, folder) if folder else self._root
        return storage.join(path, name) if name else path


@dataclass(frozen=True)
class _VideoReader:
    """Decodes requested frames of one camera."""

    path: str
    version: str
    frame_places: Int[np.ndarray, " steps"]
    files: EpisodeFiles

    def __call__(self, steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        """Return the RGB frames at these control steps, in this order.

        Raises:
            InputError: The MP4 is missing, damaged, or too short.
            OSError: A file behind a URL cannot be read.
            ValueError: No steps, or a step outside the episode.
        """
        if not steps or min(steps) < 0 or max(steps) >= len(self.frame_places):
            raise ValueError(f"{self.path}: steps {list(steps)} of {len(self.frame_places)}")
        places = self.frame_places[list(steps)].tolist()
        return read_frames(self.files.open(self.path, version=self.version), places, where=self.path)


def _twice(identity: str, where: str) -> EpisodeProblem:
    found = f"a second episode of the same identity: {identity}"
    return EpisodeProblem(
        identity, where, found, "episodes that can be told apart", "Name a smaller folder in data.path"
    )
