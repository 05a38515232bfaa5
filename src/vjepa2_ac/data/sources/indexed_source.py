"""The common part of all sources: opening and indexing a data set once, and reading frames by control step."""

from __future__ import annotations

import importlib
import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Generic, Self, TypeVar

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.files import EpisodeFiles, map_in_threads, num_connections
from vjepa2_ac.data.index import STATES_NOT_READ, EpisodeProblem, EpisodeTable, StatesSummary, build_labels, nul_error
from vjepa2_ac.episode import EpisodeInfo, EpisodeSource, FrameReader, Progress, Widths, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.spaces import CAMERA_POSE, POSE, POSE_CHANGE, Spaces, StateSpace, make_vector_states

logger = logging.getLogger(__name__)


def open_source(config: DataConfig) -> EpisodeSource:
    """Create the source of a config without reading anything; only the libraries of this format are imported."""
    module, _, name = config.reader.partition(":")
    source: EpisodeSource = getattr(importlib.import_module(module), name)(config)
    return source


def get_state_space(config: DataConfig, width: int) -> StateSpace:
    """Return the space of measured states: poses in the base frame, or vectors of the given width."""
    return POSE if config.states == "pose" else make_vector_states(width)


def get_spaces(config: DataConfig, widths: Widths) -> Spaces:
    """Return the spaces of the states and actions of clips."""
    if config.states == "pose":
        return Spaces(POSE if config.pose_frame == "base" else CAMERA_POSE, POSE_CHANGE)
    return Spaces.from_widths(widths, "difference" if config.actions == "difference" else config.join_actions)


@dataclass(frozen=True)
class IndexEntry:
    """The entry of a usable episode in the index."""

    info: EpisodeInfo
    where: str  # the file of the episode, for messages
    locator: Mapping[str, Any] = field(default_factory=dict)  # numbers or bytes that locate the episode
    states: StatesSummary = STATES_NOT_READ
    labels: Mapping[str, str | None] = field(default_factory=dict)
    rate_hz: float | None = None  # control steps per second; None: unknown
    kind: str = ""  # description of the properties that all episodes must share


ScanResult = IndexEntry | EpisodeProblem


def build_table(
    results: Iterable[ScanResult], config: DataConfig, total: int, progress: Progress = no_progress
) -> EpisodeTable:
    """Build the table of all episodes from the results of a scan.

    If several episodes have the same identity, only the first is usable. Episodes whose kind differs from the most
    frequent kind are not usable.

    Args:
        results: The result of each episode, in the source's order.
        config: The data.
        total: Number of episodes.
        progress: Called with (done, total) after each episode.

    Raises:
        InputError: No episode can be used; this is the error of the first episode.
    """
    usable: dict[str, IndexEntry] = {}
    problems: list[EpisodeProblem] = []
    kinds: dict[str, int] = {}  # number of episodes of each kind
    for num_done, result in enumerate(results, start=1):
        if isinstance(result, EpisodeProblem):
            problems.append(result)
        elif "\0" in result.info.id:
            problems.append(EpisodeProblem.from_error(nul_error(result.info.id, result.where), result.info.id))
        elif (first := usable.setdefault(result.info.id, result)) is result:
            kinds[result.kind] = kinds.get(result.kind, 0) + 1
        else:
            problem = f"the identity {result.info.id} is also the identity of {first.where}"
            needed = "a unique identity for each episode, because the split is a hash of the identity"
            problems.append(EpisodeProblem(result.info.id, result.where, problem, needed, config.same_identity_fix))
        progress(num_done, total)
    if not usable:
        raise problems[0].error
    main_kind = max(kinds, key=lambda kind: kinds[kind])
    fix = "Resample the episode, or store the recordings of different robots in different folders"
    for name, entry in usable.items():
        if entry.kind != main_kind:
            needed = f"{main_kind}, as in most episodes"
            problems.append(EpisodeProblem(name, entry.where, entry.kind, needed, fix))
    entries = [entry for entry in usable.values() if entry.kind == main_kind]
    logger.info("%s: %d usable episodes, %d unusable episodes", config.path, len(entries), len(problems))
    hashes, rate = [entry.states.state_hash for entry in entries], entries[0].rate_hz
    return replace(
        EpisodeTable.from_infos([entry.info for entry in entries]),
        problems=tuple(problems),
        locators={name: np.array([entry.locator[name] for entry in entries]) for name in entries[0].locator},
        texts={} if rate is None else {"control_rate_hz": str(rate)},
        state_hash=np.array(hashes, np.uint64) if any(hashes) else None,
        motion=np.array([entry.states.motion for entry in entries], np.float32),
        labels=build_labels([entry.labels for entry in entries]),
    )


Config = TypeVar("Config", bound=DataConfig)
State = TypeVar("State")


class IndexedSource(ABC, Generic[Config, State]):
    """A source that opens its data set when it is first used. A pickle for loader workers includes the index.

    Any number of threads may use a source. A source keeps the index and the state that `_open_data_set` returns.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._opening = threading.Lock()  # one lock per source, because `_open_data_set` may open another source
        self._index_and_state: tuple[EpisodeTable, State] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle for a loader worker, with the index."""
        return type(self), (self._config,), {"_index_and_state": self._index_and_state}

    def infos(self, progress: Progress | None = None) -> EpisodeTable:
        """Return identity, length and outcome of every usable episode, and the problems of unusable episodes.

        Raises:
            InputError: There is no data set, it does not match the config, or no episode can be used.
            OSError: Data behind a URL cannot be read.
        """
        return self._open(progress or no_progress)[0]

    def with_raw_states(self) -> Self:
        """Return a source of the same episodes that reads states as unconverted vectors; the index is shared."""
        source = type(self)(self._config.model_copy(update={"states": "vector"}))
        source._index_and_state = self._index_and_state
        return source

    @cached_property
    def _files(self) -> EpisodeFiles:
        return EpisodeFiles(self._config)

    def _open(self, progress: Progress = no_progress) -> tuple[EpisodeTable, State]:
        with self._opening:
            if self._index_and_state is None:
                self._index_and_state = self._open_data_set(progress)
            return self._index_and_state

    def _scan_all(
        self, scan: Callable[[str], IndexEntry], identities: Mapping[str, str], progress: Progress
    ) -> EpisodeTable:
        """Scan all episodes and return their table.

        Args:
            scan: Reads an episode, given by its key in `identities`.
            identities: Identities of the episodes by key.
            progress: Called with (done, total) after each episode.

        Raises:
            InputError: No episode can be used; this is the error of the first episode.
            OSError: Data behind a URL cannot be read.
        """

        def scan_episode(key: str) -> ScanResult:
            try:
                return scan(key)
            except InputError as error:
                return EpisodeProblem.from_error(error, identities[key])

        results = map_in_threads(scan_episode, [*identities], num_connections(self._config))
        return build_table(results, self._config, len(identities), progress)

    @abstractmethod
    def _open_data_set(self, progress: Progress) -> tuple[EpisodeTable, State]:
        """Open the data set; return its index, from the cache or by a scan, and the source-specific state."""


def make_frame_reader(num_steps: int, where: str, decode: FrameReader) -> FrameReader:
    """Return a reader of the frames of one camera of an episode that refuses steps outside the episode.

    Args:
        num_steps: Number of steps of the episode.
        where: File and episode, for messages.
        decode: Returns the RGB frames at steps within the episode, in the requested order.
    """

    def read(steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        if not steps or min(steps) < 0 or max(steps) >= num_steps:
            raise ValueError(f"{where}: steps {list(steps)} requested. Expected steps from 0 to {num_steps - 1}.")
        return decode(steps)

    return read


def require_indexed_length(num_steps: int, info: EpisodeInfo, where: str) -> None:
    """Refuse an episode whose length differs from its length in the index.

    Raises:
        InputError: The lengths differ.
    """
    if num_steps != info.num_steps:
        needed = f"{info.num_steps}, as when the data set was indexed"
        fix = "Do not change files while a run reads them"
        raise InputError(where=where, found=counted(num_steps, "step"), needed=needed, fix=fix)
