"""Source of plain .npz files: one file per episode, in a folder or in folders below it."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.index.episode_table import EpisodeProblem, EpisodeTable
from vjepa2_ac.data.index.index_cache import IndexKeys, get_or_build
from vjepa2_ac.data.index.labels import labels_of
from vjepa2_ac.data.index.state_hash import hash_of_states
from vjepa2_ac.data.selection import as_error, as_problem
from vjepa2_ac.data.sources.indexed_source import FramesByStep, IndexedSource, Opened, require_as_indexed
from vjepa2_ac.data.sources.listing import in_parallel, walk, within
from vjepa2_ac.data.sources.npz.npz_episode import FORMAT_HELP, NpzEpisode, opened_npz, read_episode, require_frames
from vjepa2_ac.episode import Episode, EpisodeInfo, Progress, StepRanges
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.block_file import BlockCachedFile

logger = logging.getLogger(__name__)

_SUFFIX = ".npz"


@dataclass(frozen=True)
class _Opened(Opened):
    version: str  # of all files: the key of the index


class NpzSource(IndexedSource[DataConfig, _Opened]):
    """The episodes of a folder of .npz files, in the order of their paths; a path without .npz is the identity.

    `infos` reads every file except the frames. Data from URLs is cached on this machine.
    """

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - files are fetched in blocks
        """Return one episode; only requested frames are read.

        Raises:
            InputError: The file is missing or damaged, or has changed since it was indexed.
            OSError: Data behind a URL cannot be read.
        """
        opened = self._open()
        info = opened.table[index]
        path, camera = self._path(info.id), camera or self._config.cameras[0]
        found = read_episode(self._opened(path, opened.version), path, (camera,), self._config)
        require_as_indexed(len(found.states), info, path)
        return Episode(
            info=info,
            states=found.states,
            read_frames=FramesByStep(info.num_steps, path, partial(self._frames, path, camera, info.num_steps)),
            control_rate_hz=found.fps_hz,
            extrinsics=found.extrinsics[camera],
            joint_velocities=found.joint_velocities,
            metadata={} if found.language is None else {"language": found.language},
            commands=found.commands,
        )

    def _frames(
        self, path: str, camera: str, num_steps: int, steps: Sequence[int]
    ) -> UInt8[np.ndarray, "time height width 3"]:
        with opened_npz(self._opened(path, self._open().version), path) as file:
            require_frames(file, camera, num_steps, path, count=len(set(steps)))
            return np.asarray(file.rows(camera, steps))

    def _look(self, progress: Progress) -> _Opened:
        """Return the cached table, or read every episode; a changed file changes the key."""
        config, root = self._config, self._config.path
        listed = sorted(
            (within(folder, file.name), file.size, file.version)
            for folder, file in walk(root, config.connections)
            if file.name.endswith(_SUFFIX)
        )
        if not listed:
            found = f"no .npz files under {root}"
            raise InputError(where="data.path", found=found, needed="one for each episode", fix=FORMAT_HELP)
        knobs: dict[str, object] = {"cameras": config.cameras, "pose_frame": config.pose_frame}
        if config.states == "vector":
            knobs |= {"states": config.states, "actions": config.actions}
        keys = IndexKeys.of({"source": "npz", **knobs, "listed": listed}, root)
        ids = [path.removesuffix(_SUFFIX) for path, _, _ in listed]
        build = partial(self._scan_all, ids, keys.now, progress)
        return _Opened(get_or_build(config.disk_cache, keys, root, build), keys.now)

    def _scan_all(self, ids: list[str], version: str, progress: Progress) -> EpisodeTable:
        found: dict[str, NpzEpisode] = {}
        problems: list[EpisodeProblem] = []
        results = in_parallel(partial(self._scan, version=version), ids, self._connections)
        for done, (identity, one) in enumerate(zip(ids, results, strict=True), start=1):
            progress(done, len(ids))
            if isinstance(one, EpisodeProblem):
                problems.append(one)
            else:
                found[identity] = one
        if not found:
            raise as_error(problems[0])
        rate = Counter(one.fps_hz for one in found.values()).most_common(1)[0][0]
        problems += [self._other_rate(name, one.fps_hz, rate) for name, one in found.items() if one.fps_hz != rate]
        alike = {name: one for name, one in found.items() if one.fps_hz == rate}
        usual = Counter(one.widths for one in alike.values()).most_common(1)[0][0]
        problems += [self._other_widths(name, one.widths, usual) for name, one in alike.items() if one.widths != usual]
        usable = {name: one for name, one in alike.items() if one.widths == usual}
        logger.info("%s: %d episodes, %d that cannot be used", self._config.path, len(usable), len(problems))
        return EpisodeTable.of(
            [EpisodeInfo(name, len(one.states), one.success) for name, one in usable.items()],
            problems=problems,
            texts={"control_rate_hz": str(rate)},
            state_hashes=[hash_of_states(one.states) for one in usable.values()],
            labels=labels_of([{"task": one.language, **one.labels} for one in usable.values()]),
        )

    def _scan(self, identity: str, version: str) -> NpzEpisode | EpisodeProblem:
        try:
            path = self._path(identity)
            return read_episode(self._opened(path, version), path, self._config.cameras, self._config)
        except InputError as error:
            return as_problem(error, identity)

    def _other_rate(self, identity: str, rate: float, others: float) -> EpisodeProblem:
        needed = f"{others:g}, as in most episodes: strides count control steps"
        return EpisodeProblem(identity, f"{self._path(identity)}: fps_hz", f"{rate:g}", needed, "Resample the episode")

    def _other_widths(
        self, identity: str, widths: tuple[int, int | None], others: tuple[int, int | None]
    ) -> EpisodeProblem:
        found, needed = (
            f"{state} numbers a state" + ("" if action is None else f", {action} an action")
            for state, action in (widths, others)
        )
        fix = "Keep the recordings of different robots in different folders"
        return EpisodeProblem(identity, self._path(identity), found, f"{needed}, as in most episodes", fix)

    def _opened(self, path: str, version: str) -> str | BlockCachedFile:
        return self._files.open(path, version=version)

    def _path(self, identity: str) -> str:
        return storage.join(self._config.path, identity + _SUFFIX)
