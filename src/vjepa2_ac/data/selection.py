"""Which episodes and control steps a run uses: exclusion, broken episodes, and ranges of steps."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int32, UInt64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.index import EpisodeProblem, EpisodeTable, NotATableError, identity_hash, pack, unpack
from vjepa2_ac.episode import StepRanges
from vjepa2_ac.errors import InputError

logger = logging.getLogger(__name__)

NAMED = 10  # episodes in one message, at most
_ALLOWED_BROKEN = 3  # episodes, in all but the smallest data sets
_ALLOWED_SHARE = 0.01  # of the episodes, in large data sets


@dataclass(frozen=True, eq=False)
class StepSelection:
    """Ranges [start, end) of control steps that a clip must fit into; by episode, then ascending and disjoint."""

    episode: Int32[np.ndarray, " ranges"]  # index into the table
    start: Int32[np.ndarray, " ranges"]
    end: Int32[np.ndarray, " ranges"]
    problems: tuple[tuple[int, EpisodeProblem], ...] = ()  # the episodes that could not be read, by the same index

    @classmethod
    def whole(cls, table: EpisodeTable, taking_part: Bool[np.ndarray, " episodes"]) -> StepSelection:
        """Keep every step of the used episodes."""
        episode = np.flatnonzero(taking_part).astype(np.int32)
        return cls(episode, np.zeros(len(episode), np.int32), table.num_steps[episode])

    @classmethod
    def of_each(cls, found: Sequence[list[tuple[int, int]] | EpisodeProblem]) -> StepSelection:
        """Join the ranges of all episodes."""
        problems = tuple((place, one) for place, one in enumerate(found) if isinstance(one, EpisodeProblem))
        ranges = [(place, *pair) for place, one in enumerate(found) if isinstance(one, list) for pair in one]
        episode, start, end = np.ascontiguousarray(np.array(ranges, np.int32).reshape(-1, 3).T)
        return cls(episode, start, end, problems)

    def only(self, episodes: Bool[np.ndarray, " episodes"]) -> StepSelection:
        """Return the selection with these episodes only."""
        stays = episodes[self.episode]
        return replace(self, episode=self.episode[stays], start=self.start[stays], end=self.end[stays])

    def of(self, episode: int) -> StepRanges:
        """Return the ranges of one episode."""
        first, last = np.searchsorted(self.episode, np.array([episode, episode + 1], np.int32))
        return tuple(zip(self.start[first:last].tolist(), self.end[first:last].tolist(), strict=True))

    @property
    def steps(self) -> int:
        """The total number of kept steps."""
        return int((self.end.astype(np.int64) - self.start).sum())

    def to_bytes(self) -> bytes:
        """Return this as a file's content."""
        problems = [(place, vars(problem)) for place, problem in self.problems]
        return pack({"episode": self.episode, "start": self.start, "end": self.end}, problems)

    @classmethod
    def from_bytes(cls, data: bytes) -> StepSelection:
        """Read the result of `to_bytes`.

        Raises:
            NotATableError: It is another kind of file, or damaged.
        """
        arrays, problems = unpack(data)
        try:
            return cls(**arrays, problems=tuple((place, EpisodeProblem(**values)) for place, values in problems))
        except (LookupError, TypeError, ValueError) as error:
            raise NotATableError(f"no ranges of steps ({error})") from None


def included(table: EpisodeTable, config: DataConfig) -> Bool[np.ndarray, " episodes"]:
    """Return which episodes are used: all except those in `data.exclude`.

    Raises:
        InputError: `data.exclude` contains an unknown identity.
    """
    excluded = frozenset(config.exclude)
    hashes = np.array([identity_hash(name) for name in excluded], np.uint64)
    candidates = np.flatnonzero(np.isin(table.id_hash, hashes)).tolist()
    found = {place: name for place in candidates if (name := table.identity(place)) in excluded}
    unknown = excluded.difference(found.values(), (problem.name for problem in table.problems))
    if unknown:
        wrong = f"not the identity of any episode: {named(sorted(unknown))}"
        needed = "identities as errors name them" + (f", such as {table.identity(0)}" if len(table) else "")
        raise InputError(where="data.exclude", found=wrong, needed=needed)
    taking_part = np.ones(len(table), bool)
    taking_part[list(found)] = False
    return taking_part


def of_outcome(table: EpisodeTable, config: DataConfig) -> Bool[np.ndarray, " episodes"]:
    """Return which episodes have the outcome of `data.outcome`.

    Raises:
        InputError: No episode says whether it succeeded.
    """
    if config.outcome == "all":
        return np.ones(len(table), bool)
    if len(table) and (table.success < 0).all():
        found = f"no episode of {config.path} says whether it succeeded"
        raise InputError(where=f"data.outcome: {config.outcome}", found=found, fix="Set data.outcome: all")
    return np.asarray(table.success == (config.outcome == "success"))


def require_distinct(table: EpisodeTable, taking_part: Bool[np.ndarray, " episodes"], config: DataConfig) -> None:
    """Refuse two episodes with one identity: they would share a split, and an error could not name one of them.

    Raises:
        InputError: There are two.
    """
    members = np.flatnonzero(taking_part)
    hashes, counts = np.unique(table.id_hash[members], return_counts=True)
    places: dict[str, int] = {}
    for place in members[np.isin(table.id_hash[members], hashes[counts > 1])].tolist():
        name = table.identity(place)
        if name in places:
            found, fix = f"episodes {places[name]} and {place} have the same identity: {name}", config.same_identity_fix
            error = InputError(where=f"data.path: {config.path}", found=found, fix=fix)
            raise with_exclusion(error, [name]) if hashes.size > 1 else error
        places[name] = place


def max_broken(episodes: int) -> int:
    """Return how many broken episodes of a data set `data.broken_episodes: skip` leaves out before it stops.

    3 or 1 %, whichever is larger, but of fewer than 6 episodes at most half: where most episodes cannot be read, a
    setting is wrong rather than the recordings.
    """
    return max(min(_ALLOWED_BROKEN, episodes // 2), int(_ALLOWED_SHARE * episodes))


class BrokenEpisodes:
    """The broken episodes of an opened data set: those found while opening it, and those found by clips since.

    It is in the process that opened the data set; loader workers report to it. `data.broken_episodes` is the policy:
    stop at the first, or skip and count them, and stop where too many are broken.

    Args:
        config: The data.
        episodes: How many there are, broken ones included.
        usable: The hashes of the identities of the episodes that clips may come from; None: not known.
    """

    def __init__(self, config: DataConfig, episodes: int, usable: UInt64[np.ndarray, " usable"] | None = None) -> None:
        self._config, self._episodes, self._usable = config, episodes, usable
        self.reasons: dict[str, str] = {}  # of the broken episodes, in the order in which they were found

    def __len__(self) -> int:
        return len(self.reasons)

    def found(self, problems: Sequence[EpisodeProblem]) -> None:
        """Record the problems found while the data set was opened or indexed.

        Raises:
            InputError: `data.broken_episodes` is error: the first of them; or too many are broken.
        """
        if not problems:
            return
        names = [problem.name for problem in problems]
        if self._config.broken_episodes == "error":
            first, more = problems[0], len(problems) - 1
            more_problems = f"{more} more cannot be used either. " if more else ""
            raise self.refusal(as_error(replace(first, fix=more_problems + first.fix)), names)
        logger.warning(
            "%s: %d of %d episodes are broken and left out: %s; the first: %s",
            self._config.path, len(problems), self._episodes, named(names), as_error(problems[0]),
        )  # fmt: skip
        self._add({problem.name: str(as_error(problem)) for problem in problems})

    def met(self, name: str, reason: str) -> None:
        """Record an episode of which a clip could not be read.

        Raises:
            InputError: Now too many are broken.
        """
        if name not in self.reasons:
            count = len(self) + 1
            logger.warning("A clip is left out, %d of %d episodes are broken: %s", count, self._episodes, reason)
            self._add({name: reason})

    def recall(self, reasons: Mapping[str, str]) -> None:
        """Count also what the run has found before it was resumed, or in its other processes.

        Raises:
            InputError: In total too many are broken.
        """
        self._add({name: why for name, why in reasons.items() if name not in self._config.exclude})

    def refusal(self, error: InputError, names: Sequence[str]) -> InputError:
        """Return an error of broken episodes, with the fixes that would leave them out: skip, exclusion, or none.

        Skip is a fix if the episodes are few enough; exclusion is one if other episodes remain.

        Args:
            error: The error of one of them, or of all.
            names: The identities of all that are known to be broken.
        """
        names = list(dict.fromkeys(names))
        hashes = np.array([identity_hash(name) for name in names], np.uint64)
        if self._usable is not None and np.isin(self._usable, hashes).all():  # nothing would be left
            return error
        is_few = len(names) <= max_broken(self._episodes)
        return with_exclusion(error, names, is_skippable=is_few and self._config.broken_episodes == "error")

    def _add(self, reasons: Mapping[str, str]) -> None:
        new = {name: why for name, why in reasons.items() if name not in self.reasons}
        self.reasons = {**self.reasons, **new}  # another dict: a checkpoint being written keeps the previous one
        if len(self) <= (allowed := max_broken(self._episodes)):
            return
        name, reason = next(iter(self.reasons.items()))
        found = f"{len(self)} of {self._episodes} episodes are broken. The first, {name}: {reason.rstrip('.')}"
        needed, fix = f"at most {allowed} with data.broken_episodes: skip", "Repair or fetch them again"
        error = InputError(where=f"data.path: {self._config.path}", found=found, needed=needed, fix=fix)
        raise self.refusal(error, tuple(self.reasons))


def as_error(problem: EpisodeProblem) -> InputError:
    """Return the error of an unusable episode."""
    return InputError(where=problem.where, found=problem.found, needed=problem.needed, fix=problem.fix)


def as_problem(error: InputError, name: str) -> EpisodeProblem:
    """Return the record of an unusable episode."""
    return EpisodeProblem(name=name, where=error.where, found=error.found, needed=error.needed, fix=error.fix)


def with_exclusion(error: InputError, names: Sequence[str], *, is_skippable: bool = False) -> InputError:
    """Return an error of one or more episodes whose fix says how to leave them out.

    Args:
        error: What is wrong with them.
        names: Their identities, all different; the fix lists ten at most, and the number of all.
        is_skippable: Whether `data.broken_episodes: skip` would leave them out.
    """
    fix = f"{error.fix.rstrip('.')}. " if error.fix else ""
    listed = json.dumps(names[:NAMED], ensure_ascii=False)
    of_all = f" (the first {NAMED} of {len(names)})" if len(names) > NAMED else ""
    skip = "set data.broken_episodes: skip, or " if is_skippable else ""
    fix = f"{fix}To leave {'it' if len(names) == 1 else 'them'} out, {skip}add{of_all} to data.exclude: {listed}"
    return InputError(where=error.where, found=error.found, needed=error.needed, fix=fix)


def named(ids: Sequence[str], count: int | None = None) -> str:
    """Return identities for a message: the first ten, and the number of the rest (of `count` in total)."""
    more = (len(ids) if count is None else count) - NAMED
    return ", ".join(ids[:NAMED]) + (f" and {more} more" if more > 0 else "")
