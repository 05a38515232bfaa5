"""Source of DROID's raw recordings: states from HDF5, frames from MP4, names from JSON."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import RawDroidData
from vjepa2_ac.config.section import Affects, knobs_that_affect
from vjepa2_ac.data.index.episode_table import EpisodeProblem, EpisodeTable
from vjepa2_ac.data.index.index_cache import IndexKeys, get_or_build, key_of
from vjepa2_ac.data.index.labels import labels_of
from vjepa2_ac.data.index.packed_text import pack_texts, text_of
from vjepa2_ac.data.index.state_hash import hash_of_states
from vjepa2_ac.data.selection import as_error, as_problem
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
from vjepa2_ac.data.sources.indexed_source import FramesByStep, IndexedSource, Opened, require_as_indexed
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


class RawDroidSource(IndexedSource[RawDroidData, Opened]):
    """The episodes of a raw DROID tree, or of a part of it, in the order of their paths.

    `infos` reads every trajectory and the headers of the MP4s of the config's cameras, once; data behind a URL is not
    checked again until folders are added or removed. An episode's identity is LAB/outcome/DATE/TIME
    (`episode_folders.identity_of`).

    An MP4 holds one frame per control step, in order, whatever rate its header states, and may lack the last step's.
    """

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
        require_as_indexed(len(trajectory.states), info, self._path(place.folder, TRAJECTORY))
        video = self._path(place.folder, f"{VIDEOS}/{serial}.mp4")
        return Episode(
            info=info,
            states=trajectory.states,
            read_frames=FramesByStep(info.num_steps, video, partial(self._frames, video, place.version, trajectory)),
            control_rate_hz=self._config.droid_raw.control_rate_hz,
            extrinsics=trajectory.extrinsics[serial],
            joint_velocities=trajectory.joint_velocities,
            metadata={} if metadata.language is None else {"language": metadata.language},
        )

    def _frames(
        self, video: str, version: str, trajectory: Trajectory, steps: Sequence[int]
    ) -> UInt8[np.ndarray, "time height width 3"]:
        places = trajectory.frame_places[list(steps)].tolist()
        return read_frames(self._files.open(video, version=version), places, where=video)

    def _look(self, progress: Progress) -> Opened:
        """Return the cached table, or scan every episode; a changed local file changes the key."""
        config, root = self._config, self._config.path
        folders = find_episodes(root, config.connections)
        if not folders:
            raise InputError(
                where="data.path",
                found=f"no episodes under {root}",
                needed=f"folders LAB/success|failure/DATE/TIME with a {TRAJECTORY}",
                fix="DROID's are in gs://gresearch/robotics/droid_raw/1.0.1",
            )
        listed: Sequence[EpisodeFolder | str] = folders
        if not storage.is_url(root):
            listed = [list_episode(root, folder) for folder in folders]
        own = knobs_that_affect(Affects.INDEX, config.droid_raw)
        parts = {
            "source": "droid_raw",
            "cameras": config.cameras,
            "droid_raw": " ".join(f"{name}={value!r}" for name, value in own.items()),
            "pose_frame": config.pose_frame,
            "listed": listed,
        }
        keys = IndexKeys.of(parts, root, named=identity_of(root, folders[0]))
        return Opened(get_or_build(config.disk_cache, keys, root, lambda: self._scan_all(folders, progress)))

    def _scan_all(self, folders: list[str], progress: Progress) -> EpisodeTable:
        usable: dict[str, _Found] = {}
        problems = []
        for done, found in enumerate(in_parallel(self._scan, folders, self._connections), start=1):
            progress(done, len(folders))
            if isinstance(found, EpisodeProblem):
                problems.append(found)
            elif found.info.id in usable:
                problems.append(_twice(found.info.id, self._path(found.place.folder, TRAJECTORY)))
            else:
                usable[found.info.id] = found
        if not usable:
            raise as_error(problems[0])
        logger.info("%s: %d episodes, %d that cannot be used", self._config.path, len(usable), len(problems))
        return EpisodeTable.of(
            [one.info for one in usable.values()],
            problems=problems,
            locators=pack_texts("place", [json.dumps(vars(one.place)) for one in usable.values()]),
            texts={"control_rate_hz": str(self._config.droid_raw.control_rate_hz)},
            state_hashes=[one.state_hash for one in usable.values()],
            labels=labels_of([one.labels for one in usable.values()]),
        )

    def _scan(self, folder: str) -> _Found | EpisodeProblem:
        identity = identity_of(self._config.path, folder)
        listed = list_episode(self._config.path, folder)
        if not listed.has_trajectory or listed.metadata is None:
            found = f"episode {identity} has no {'metadata_*.json' if listed.has_trajectory else TRAJECTORY}"
            return EpisodeProblem(identity, self._path(folder, ""), found, "one", _FIX)
        try:
            place = _Place(folder, listed.metadata, key_of({"files": listed}), {})
            metadata = self._metadata(place)
            serials = tuple(metadata.serial(camera) for camera in self._config.cameras)
            place = replace(place, pictures=self._counted(place, listed, serials))
            states = self._trajectory(place, serials).states
        except InputError as error:
            return as_problem(error, identity)
        success = success_of(identity) if metadata.success is None else metadata.success
        info = EpisodeInfo(identity, len(states), success)
        return _Found(info, place, hash_of_states(states), metadata.labels)

    def _counted(self, place: _Place, listed: EpisodeFolder, serials: tuple[str, ...]) -> dict[str, int]:
        """Return the number of frames of each camera."""
        counts = {}
        for serial in serials:
            path = self._path(place.folder, f"{VIDEOS}/{serial}.mp4")
            if not any(video.name == f"{serial}.mp4" for video in listed.videos):
                there = ", ".join(video.name for video in listed.videos) or "none"
                needed = f"the MP4 that {place.metadata} or data.camera names; there are {there}"
                raise InputError(where=path, found="no such file", needed=needed, fix=_FIX)
            counts[serial] = count_frames(path, where=path)
        return counts

    def _metadata(self, place: _Place) -> DroidMetadata:
        path = self._path(place.folder, place.metadata)
        return DroidMetadata.parse(self._files.read(path, version=place.version, where=path), path)

    def _trajectory(self, place: _Place, serials: tuple[str, ...]) -> Trajectory:
        path = self._path(place.folder, TRAJECTORY)
        data = self._files.read(path, version=place.version, where=path)
        trajectory = parse_trajectory(data, where=path, serials=serials, frame_counts=place.pictures)
        if self._config.pose_frame == "camera" and any(trajectory.extrinsics[serial] is None for serial in serials):
            needed = "observation/camera_extrinsics of the camera"
            raise InputError(where=path, found="no poses of the camera", needed=needed, fix="Set data.pose_frame: base")
        if self._config.droid_raw.skip_action == "drop":
            trajectory = trajectory.at(np.flatnonzero(~trajectory.skipped))
        POSE.require_plausible(trajectory.states, path, fix=_FIX)
        return trajectory

    def _path(self, folder: str, name: str) -> str:
        path = storage.join(self._config.path, folder) if folder else self._config.path
        return storage.join(path, name) if name else path


def _twice(identity: str, where: str) -> EpisodeProblem:
    found, fix = f"a second episode of the same identity: {identity}", "Name a smaller folder in data.path"
    return EpisodeProblem(identity, where, found, "episodes that can be told apart", fix)
