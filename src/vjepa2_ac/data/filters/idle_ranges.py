"""The steps that the idle filter leaves of every episode: read from its cache, or computed once and cached on disk."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Int32

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig, LeRobotFields, RawDroidOptions, RldsFields
from vjepa2_ac.config.section import Affects, knobs_that_affect
from vjepa2_ac.data.filters.broken_episodes import as_error, as_problem
from vjepa2_ac.data.filters.idle_rules import kept_ranges
from vjepa2_ac.data.index import EpisodeProblem, EpisodeTable, NotATableError, fingerprint_of, get_or_make, key_of
from vjepa2_ac.episode import EpisodeSource, Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.npz_reader import read_arrays
from vjepa2_ac.storage.structured import json_object, record_of, shown

logger = logging.getLogger(__name__)

_MOST_BYTES = 1 << 28  # of a published list
_ALL_BROKEN = 10  # so many broken episodes at the start, and no others, have one cause

Found = list[tuple[int, int]] | EpisodeProblem


@dataclass(frozen=True, eq=False)
class FoundRanges:
    """The remaining ranges [start, end) of all episodes of a table, and the episodes that could not be read."""

    episode: Int32[np.ndarray, " ranges"]  # ascending
    start: Int32[np.ndarray, " ranges"]
    end: Int32[np.ndarray, " ranges"]
    problems: tuple[tuple[int, EpisodeProblem], ...] = ()  # with the episode's place in the table
    listed: int = 0  # episodes of the table that the list knows, for the rule `published`

    @classmethod
    def of(cls, found: Sequence[Found], *, listed: int = 0) -> FoundRanges:
        """Join the results of all episodes."""
        problems = tuple((place, one) for place, one in enumerate(found) if isinstance(one, EpisodeProblem))
        ranges = [(place, *pair) for place, one in enumerate(found) if isinstance(one, list) for pair in one]
        columns = np.array(ranges, np.int32).reshape(-1, 3)
        episode, start, end = (np.ascontiguousarray(column) for column in columns.T)
        return cls(episode, start, end, problems, listed)

    def to_bytes(self) -> bytes:
        """Return this as a file's content, with checksums."""
        problems = [[place, vars(problem)] for place, problem in self.problems]
        text = json.dumps({"problems": problems, "listed": self.listed}).encode()
        file = io.BytesIO()
        np.savez(file, text=np.frombuffer(text, np.uint8), episode=self.episode, start=self.start, end=self.end)
        return file.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> FoundRanges:
        """Read the result of `to_bytes`.

        Raises:
            NotATableError: It is another kind of file, or damaged.
        """
        try:
            arrays = read_arrays(data)
            columns = (arrays["episode"], arrays["start"], arrays["end"])
            text = record_of(_Text, json_object(arrays["text"].tobytes(), where="text"), where="text")
        except (InputError, KeyError) as error:
            raise NotATableError(str(error)) from None
        if any(column.dtype != np.int32 or column.shape != (len(columns[0]),) for column in columns):
            raise NotATableError("columns that do not fit together")
        return cls(*columns, text.problems, text.listed)

    def require_of(self, table: EpisodeTable) -> None:
        """Refuse ranges that do not belong to the episodes of a table.

        Raises:
            NotATableError: They do not.
        """
        places = [place for place, _ in self.problems]
        known = len(table) > self.episode.max(initial=-1) and len(table) > max(places, default=-1)
        if not known or self.episode.min(initial=0) < 0 or min(places, default=0) < 0:
            raise NotATableError(f"ranges of other episodes than these {len(table)}")
        within = (self.start >= 0) & (self.start <= self.end) & (self.end <= table.num_steps[self.episode])
        if not within.all() or (np.diff(self.episode) < 0).any():
            raise NotATableError("ranges that are not in their episodes, or not in their order")


@dataclass(frozen=True)
class _Text:
    """The parts of the ranges that are not numbers."""

    problems: tuple[tuple[int, EpisodeProblem], ...]
    listed: int


def find_ranges(
    source: EpisodeSource, table: EpisodeTable, config: DataConfig, progress: Progress | None
) -> FoundRanges:
    """Return the ranges that `data.idle.rule` keeps, of all episodes, used or not.

    Raises:
        InputError: The list of ranges cannot be read or belongs to another data set; or the rule fits no episode.
    """
    knobs = _sections_as_written_before() | knobs_that_affect(Affects.IDLE, config)
    if storage.is_url(config.path):  # its fingerprint is what it was, and so is this key
        knobs["path"] = config.path
    parts: dict[str, object] = {"found": "idle ranges", "table": fingerprint_of(table), "data": knobs}
    make = partial(_computed, source, table, config, progress)
    if config.idle.rule == "published":
        path = str(config.idle.ranges)
        make, parts["list"] = partial(_published, path, table), _version(path)
    return get_or_make(
        config.disk_cache, key_of(parts), make, to_bytes=FoundRanges.to_bytes, from_bytes=FoundRanges.from_bytes
    )


def _computed(source: EpisodeSource, table: EpisodeTable, config: DataConfig, progress: Progress | None) -> FoundRanges:
    def look(place: int) -> Found:
        try:
            return kept_ranges(source.read(place), config.idle)
        except InputError as error:
            return as_problem(error, table.identity(place))

    threads = config.connections if storage.is_url(config.path) else 1
    found: list[Found] = []
    for one in _in_order(look, len(table), threads):
        found.append(one)
        if progress is not None:
            progress(len(found), len(table))
        if isinstance(one, EpisodeProblem) and len(found) == min(_ALL_BROKEN, len(table)):
            _refuse_all_broken(found)
    return FoundRanges.of(found)


def _in_order(look: Callable[[int], Found], count: int, threads: int) -> Iterator[Found]:
    """Read every episode, several at once; errors are raised in the episodes' order."""
    with ThreadPoolExecutor(threads) as pool:
        for first in range(0, count, 4 * threads):
            yield from pool.map(look, range(first, min(first + 4 * threads, count)))


def _refuse_all_broken(found: list[Found]) -> None:
    problems = [one for one in found if isinstance(one, EpisodeProblem)]
    if len(problems) == len(found):
        raise as_error(problems[0])


def _published(path: str, table: EpisodeTable) -> FoundRanges:
    lists = _read_list(path)
    names = [table.identity(place) for place in range(len(table))]
    listed = sum(name in lists for name in names)
    if not listed:
        first = next(iter(lists), "none at all")
        raise InputError(
            where=f"data.idle.ranges: {path}",
            found=f"none of the {len(table)} episodes; its first is {first}",
            needed="the identities of the episodes" + (f", such as {names[0]}" if names else ""),
            fix="Name the list of this version of the data set, or set data.idle.rule: commands or motion",
        )
    steps = table.num_steps.tolist()
    found = [_checked(lists.get(name, []), name, count, path) for name, count in zip(names, steps, strict=True)]
    return FoundRanges.of(found, listed=listed)


def _read_list(path: str) -> dict[str, object]:
    needed = 'a JSON object {"identity of an episode": [[start, end], ...], ...}'
    where = f"data.idle.ranges: {path}"
    try:
        return json_object(storage.read_bounded(path, _MOST_BYTES), where=where, needed=needed)
    except OSError as error:
        raise InputError(where=where, found=f"cannot be read ({error})", needed=needed) from None


def _checked(ranges: object, name: str, steps: int, path: str) -> list[tuple[int, int]]:
    try:
        pairs = sorted((start, end) for start, end in ranges)  # type: ignore[attr-defined] # that is what is tried
        whole = all(type(number) is int for pair in pairs for number in pair)
    except (TypeError, ValueError):
        pairs, whole = [], False
    edges = [edge for pair in pairs for edge in pair]
    if not whole or edges != sorted(edges) or any(start == end for start, end in pairs):
        raise InputError(
            where=f"data.idle.ranges: {path}: {name}",
            found=shown(ranges),
            needed="pairs [start, end) of steps that do not overlap",
        )
    if edges and not 0 <= edges[0] <= edges[-1] <= steps:
        raise InputError(
            where=f"data.idle.ranges: {path}: {name}",
            found=f"steps {edges[0]} to {edges[-1]}",
            needed=f"steps from 0 to {steps}, which is the length of the episode",
            fix="Name the list of this version of the data set, or set data.idle.rule: commands or motion",
        )
    return pairs


def _sections_as_written_before() -> dict[str, object]:
    """Return the knobs of the other forms of data, which earlier versions had in each config, and so in this key."""
    sections = {"fields": RldsFields(), "droid_raw": RawDroidOptions(), "lerobot": LeRobotFields()}
    return {name: knobs_that_affect(Affects.IDLE, section) for name, section in sections.items()}


def _version(path: str) -> list[object]:
    """Return the version of the list, without reading it if possible."""
    try:
        return [storage.absolute(path), storage.file_size(path), storage.file_version(path)]
    except OSError:
        return [path]
