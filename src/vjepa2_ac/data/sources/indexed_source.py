"""The common part of all sources: opened and indexed once, and frames read by control step."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.cache import EpisodeFiles
from vjepa2_ac.data.index import EpisodeProblem, EpisodeTable
from vjepa2_ac.data.selection import as_error, as_problem
from vjepa2_ac.data.sources.listing import in_parallel
from vjepa2_ac.episode import EpisodeInfo, Progress, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.block_file import DiskCache
from vjepa2_ac.storage.npz_reader import arrays_as_bytes, read_arrays


@dataclass(frozen=True)
class Opened:
    """The state of an indexed data set; sources add what else they need to read an episode."""

    table: EpisodeTable


Config = TypeVar("Config", bound=DataConfig)
State = TypeVar("State", bound=Opened)
Found = TypeVar("Found")


class IndexedSource(ABC, Generic[Config, State]):
    """A source that is opened with the first call; pickled to a loader worker, it takes the index along.

    Nothing is read before that call. Any number of threads may use it.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._known: State | None = None
        self._opening = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle for a loader worker, with the index."""
        return _reopened, (type(self), self._config, self._known)

    def infos(self, progress: Progress | None = None) -> EpisodeTable:
        """Return identity, length and outcome of every usable episode, and the problems of the others.

        Raises:
            InputError: No data set, one that does not fit the config, or no episode that can be used.
            OSError: Data behind a URL cannot be read.
        """
        return self._open(progress or no_progress).table

    @cached_property
    def _files(self) -> EpisodeFiles:
        return EpisodeFiles(self._config)

    @property
    def _connections(self) -> int:
        """How many files are read at once: behind a URL, where each is waited for, several."""
        return self._config.connections if storage.is_url(self._config.path) else 1

    def _open(self, progress: Progress = no_progress) -> State:
        with self._opening:
            if self._known is None:
                self._known = self._look(progress)
            return self._known

    def _scanned(
        self, scan: Callable[[str], Found], identities: Mapping[str, str], progress: Progress
    ) -> tuple[list[tuple[str, Found]], list[EpisodeProblem]]:
        """Return the identity and content of every episode that can be used, and the problems of the others.

        Args:
            scan: Reads an episode, given by its key among the identities.
            identities: Of the episodes.
            progress: Called after each.

        Raises:
            InputError: No episode can be used: the first one's error.
            OSError: Data behind a URL cannot be read.
        """

        def scan_one(key: str) -> Found | EpisodeProblem:
            try:
                return scan(key)
            except InputError as error:
                return as_problem(error, identities[key])

        found: list[tuple[str, Found]] = []
        problems: list[EpisodeProblem] = []
        for identity, one in zip(
            identities.values(), in_parallel(scan_one, [*identities], self._connections), strict=True
        ):
            if isinstance(one, EpisodeProblem):
                problems.append(one)
            else:
                found.append((identity, one))
            progress(len(found) + len(problems), len(identities))
        if not found:
            raise as_error(problems[0])
        return found, problems

    @abstractmethod
    def _look(self, progress: Progress) -> State:
        """Open the data set: read its index from the cache, or scan it."""


def _reopened(kind: type[IndexedSource[Any, Any]], config: DataConfig, known: Opened | None) -> object:
    source = kind(config)
    source._known = known
    return source


@dataclass(frozen=True)
class FramesByStep:
    """Reads the frames of one camera of an episode; see `episode.FrameReader`."""

    num_steps: int
    where: str  # file and episode, for messages
    decode: Callable[[Sequence[int]], UInt8[np.ndarray, "time height width 3"]]  # of steps within the episode

    def __call__(self, steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        """Return the RGB frames at these control steps, in this order.

        Raises:
            InputError: A frame is missing, damaged or of another size, or its file has changed.
            OSError: A file behind a URL cannot be read.
            ValueError: No steps, or a step outside the episode.
        """
        if not steps or min(steps) < 0 or max(steps) >= self.num_steps:
            raise ValueError(f"{self.where}: steps {list(steps)} of {self.num_steps}")
        return self.decode(steps)


def require_as_indexed(found: int, info: EpisodeInfo, where: str) -> None:
    """Refuse an episode of another length than when it was indexed.

    Raises:
        InputError: It is.
    """
    if found != info.num_steps:
        needed, fix = f"the {info.num_steps} that were indexed", "Do not change files while a run reads them"
        raise InputError(where=where, found=f"{found} steps", needed=needed, fix=fix)


def stored_arrays(cache: DiskCache, key: str) -> dict[str, np.ndarray] | None:
    """Return the arrays that `store_arrays` wrote; None if there are none, or they are damaged."""
    data = cache.read(key)
    with suppress(InputError):
        return None if data is None else read_arrays(data)
    return None


def store_arrays(cache: DiskCache, key: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Keep what was parsed of an episode on this machine, within the limit of the disk cache."""
    cache.write(key, arrays_as_bytes(arrays))
