"""Source of plain .npz files: one file per episode, in a folder or in folders below it."""

from __future__ import annotations

import itertools
import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.cache.block_cached_file import BlockCachedFile
from vjepa2_ac.data.cache.cached_reads import EpisodeFiles
from vjepa2_ac.data.filters.broken_episodes import as_error, as_problem
from vjepa2_ac.data.index.episode_table import EpisodeProblem, EpisodeTable
from vjepa2_ac.data.index.index_cache import IndexKeys, get_or_build
from vjepa2_ac.data.index.labels import labels_of
from vjepa2_ac.data.index.state_hash import hash_of_states
from vjepa2_ac.data.sources.listing import in_parallel, walk, within
from vjepa2_ac.data.sources.npz.npz_episode import FORMAT_HELP, NpzEpisode, opened_npz, read_episode, require_frames
from vjepa2_ac.episode import Episode, EpisodeInfo, Progress, StepRanges
from vjepa2_ac.errors import InputError

logger = logging.getLogger(__name__)

_SUFFIX = ".npz"


class NpzSource:
    """The episodes of a folder of .npz files, in the order of their paths; a path without .npz is the identity.

    Nothing is read before the first call. `infos` reads every file except the frames. Data from URLs is cached on this
    machine.
    """

    def __init__(self, config: DataConfig) -> None:
        self._config = config
        self._root = config.path
        self._files = EpisodeFiles(config)
        self._version = ""  # of all files: the key of the index
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

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - files are fetched in blocks
        """Return one episode; only requested frames are read.

        Raises:
            InputError: The file is missing or damaged, or has changed since it was indexed.
            OSError: Data behind a URL cannot be read.
        """
        info = self.infos()[index]
        path = self._path(info.id)
        camera = camera or self._config.cameras[0]
        found = read_episode(self._opened(path), path, (camera,), self._config)
        if len(found.states) != info.num_steps:
            raise InputError(
                where=path,
                found=f"{len(found.states)} steps",
                needed=f"the {info.num_steps} that were indexed",
                fix="Do not change files while a run reads them",
            )
        return Episode(
            info=info,
            states=found.states,
            read_frames=_FrameReader(partial(self._opened, path), path, camera, info.num_steps),
            control_rate_hz=found.fps_hz,
            extrinsics=found.extrinsics[camera],
            joint_velocities=found.joint_velocities,
            metadata={} if found.language is None else {"language": found.language},
            commands=found.commands,
        )

    def _indexed(self, progress: Progress | None) -> EpisodeTable:
        """Return the cached table, or read every episode; a changed file changes the key."""
        config = self._config
        listed = sorted(
            (within(folder, file.name), file.size, file.version)
            for folder, file in walk(self._root, config.connections)
            if file.name.endswith(_SUFFIX)
        )
        if not listed:
            raise InputError(
                where="data.path",
                found=f"no .npz files under {self._root}",
                needed="one for each episode",
                fix=FORMAT_HELP,
            )
        knobs: dict[str, object] = {"cameras": config.cameras, "pose_frame": config.pose_frame}
        if config.states == "vector":
            knobs |= {"states": config.states, "actions": config.actions}
        keys = IndexKeys.of({"source": "npz", **knobs, "listed": listed}, self._root)
        self._version = keys.now
        ids = [path.removesuffix(_SUFFIX) for path, _, _ in listed]
        return get_or_build(config.disk_cache, keys, self._root, lambda: self._scan_all(ids, progress))

    def _scan_all(self, ids: list[str], progress: Progress | None) -> EpisodeTable:
        counter = itertools.count(1)

        def scan(identity: str) -> NpzEpisode | EpisodeProblem:
            found = self._scan(identity)
            if progress is not None:
                progress(next(counter), len(ids))
            return found

        connections = self._config.connections if storage.is_url(self._root) else 1
        scanned = dict(zip(ids, in_parallel(scan, ids, connections), strict=True))
        found = {identity: one for identity, one in scanned.items() if isinstance(one, NpzEpisode)}
        problems = [one for one in scanned.values() if isinstance(one, EpisodeProblem)]
        if not found:
            raise as_error(problems[0])
        rate = Counter(one.fps_hz for one in found.values()).most_common(1)[0][0]
        problems += [self._other_rate(name, one.fps_hz, rate) for name, one in found.items() if one.fps_hz != rate]
        found = {name: one for name, one in found.items() if one.fps_hz == rate}
        widths = Counter(one.widths for one in found.values()).most_common(1)[0][0]
        problems += [
            self._other_widths(name, one.widths, widths) for name, one in found.items() if one.widths != widths
        ]
        usable = {name: one for name, one in found.items() if one.widths == widths}
        logger.info("%s: %d episodes, %d that cannot be used", self._root, len(usable), len(problems))
        return EpisodeTable.of(
            [EpisodeInfo(name, len(one.states), one.success) for name, one in usable.items()],
            problems=problems,
            texts={"control_rate_hz": str(rate)},
            state_hashes=[hash_of_states(one.states) for one in usable.values()],
            labels=labels_of([{"task": one.language, **one.labels} for one in usable.values()]),
        )

    def _scan(self, identity: str) -> NpzEpisode | EpisodeProblem:
        try:
            path = self._path(identity)
            return read_episode(self._opened(path), path, self._config.cameras, self._config)
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

    def _opened(self, path: str) -> str | BlockCachedFile:
        return self._files.open(path, version=self._version)

    def _path(self, identity: str) -> str:
        return storage.join(self._root, identity + _SUFFIX)


@dataclass(frozen=True)
class _FrameReader:
    """Reads requested frames of one camera."""

    opened: Callable[[], str | BlockCachedFile]
    path: str
    camera: str
    steps: int

    def __call__(self, steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        """Return the RGB frames at these control steps, in this order.

        Raises:
            InputError: The file is missing or damaged.
            OSError: A file behind a URL cannot be read.
            ValueError: No steps, or a step outside the episode.
        """
        if not steps or min(steps) < 0 or max(steps) >= self.steps:
            raise ValueError(f"{self.path}: steps {list(steps)} of {self.steps}")
        with opened_npz(self.opened(), self.path) as file:
            require_frames(file, self.camera, self.steps, self.path, count=len(set(steps)))
            return np.asarray(file.rows(self.camera, steps))
