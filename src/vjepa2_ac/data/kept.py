"""Which control steps may clips come from? Ranges of episodes, a few bytes each, and the starts that fit into them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int32, UInt64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.table import EpisodeTable
from vjepa2_ac.episode import StepRanges

_WINDOWS_AT_ONCE = 1 << 19  # idle windows that are drawn in one go: bounds the memory


@dataclass(frozen=True, eq=False)
class KeptSteps:
    """Ranges [start, end) of control steps that a clip must lie in, whole; by episode, then ascending and apart."""

    episode: Int32[np.ndarray, " ranges"]  # index into the table
    start: Int32[np.ndarray, " ranges"]
    end: Int32[np.ndarray, " ranges"]
    taking_part: Bool[np.ndarray, " episodes"]  # an episode may take part though none of its steps is kept

    @classmethod
    def whole(cls, table: EpisodeTable, taking_part: Bool[np.ndarray, " episodes"]) -> KeptSteps:
        """Keep every step of the episodes that take part."""
        episode = np.flatnonzero(taking_part).astype(np.int32)
        return cls(episode, np.zeros(len(episode), np.int32), table.num_steps[episode], taking_part)

    def only(self, episodes: Bool[np.ndarray, " episodes"]) -> KeptSteps:
        """Return the same with these episodes only."""
        stays = episodes[self.episode]
        ranges = replace(self, episode=self.episode[stays], start=self.start[stays], end=self.end[stays])
        return replace(ranges, taking_part=self.taking_part & episodes)

    def of(self, episode: int) -> StepRanges:
        """Return the ranges of one episode."""
        first, last = np.searchsorted(self.episode, [episode, episode + 1])
        return tuple(zip(self.start[first:last].tolist(), self.end[first:last].tolist(), strict=True))

    @property
    def steps(self) -> int:
        """How many steps are kept in all."""
        return int((self.end.astype(np.int64) - self.start).sum())


@dataclass(frozen=True, eq=False)
class Starts:
    """First steps of clips, as runs of neighbours."""

    episode: Int32[np.ndarray, " runs"]
    first: Int32[np.ndarray, " runs"]
    count: Int32[np.ndarray, " runs"]

    @property
    def windows(self) -> int:
        """How many clips there are."""
        return int(self.count.sum(dtype=np.int64))


def clip_starts(table: EpisodeTable, kept: KeptSteps, config: DataConfig) -> Starts:
    """Return every start of a clip, by the episodes' identities: those of kept steps, and a share of the idle ones."""
    counts = kept.end - kept.start - (config.clip_steps - 1)
    fits = counts > 0
    runs = Starts(kept.episode[fits], kept.start[fits], counts[fits])
    if config.idle.rule != "none" and config.idle.keep_share > 0:
        still = list(_still_runs(table, kept.taking_part, runs, config))
        runs = Starts(*(np.concatenate([getattr(s, name) for s in (runs, *still)]) for name in _COLUMNS))
    order = np.lexsort((runs.first, table.id_rank[runs.episode]))
    return Starts(runs.episode[order], runs.first[order], runs.count[order])


_COLUMNS = ("episode", "first", "count")


def _still_runs(
    table: EpisodeTable, taking_part: Bool[np.ndarray, " episodes"], runs: Starts, config: DataConfig
) -> Iterator[Starts]:
    """Yield the idle windows that stay: each is drawn by a hash of its identity and start."""
    gaps = _gaps(table, taking_part, runs, config)
    ends = np.cumsum(gaps.count, dtype=np.int64)
    cut = 0
    while cut < len(ends):
        before = int(ends[cut - 1]) if cut else 0
        upto = max(cut + 1, int(np.searchsorted(ends, before + _WINDOWS_AT_ONCE, side="right")))
        count = gaps.count[cut:upto]
        episode = np.repeat(gaps.episode[cut:upto], count)
        place = np.arange(len(episode), dtype=np.int32) - np.repeat((ends[cut:upto] - before - count), count)
        start = (np.repeat(gaps.first[cut:upto], count) + place).astype(np.int32)
        stays = drawn(table.id_hash[episode], start) < config.idle.keep_share
        yield _as_runs(episode[stays], start[stays])
        cut = upto


def _gaps(table: EpisodeTable, taking_part: Bool[np.ndarray, " episodes"], runs: Starts, config: DataConfig) -> Starts:
    """Return the starts from which a clip fits into its episode, but into none of its kept ranges."""
    windows = table.num_steps - (config.clip_steps - 1)
    members = np.flatnonzero(taking_part & (windows > 0)).astype(np.int32)
    episode = np.concatenate([runs.episode, members])  # an empty run ends each episode
    first = np.concatenate([runs.first, windows[members]])
    after = first + np.concatenate([runs.count, np.zeros_like(members)])
    order = np.lexsort((first, episode))
    episode, first, after = episode[order], first[order], after[order]
    begin = np.zeros_like(first)
    begin[1:] = np.where(episode[1:] == episode[:-1], after[:-1], 0)
    gap = first > begin
    return Starts(episode[gap], begin[gap], (first - begin)[gap])


def _as_runs(episode: Int32[np.ndarray, " windows"], start: Int32[np.ndarray, " windows"]) -> Starts:
    begins = np.ones(len(start), bool)
    begins[1:] = (episode[1:] != episode[:-1]) | (start[1:] != start[:-1] + 1)
    places = np.flatnonzero(begins)
    return Starts(episode[places], start[places], np.diff(places, append=len(start)).astype(np.int32))


def drawn(
    id_hash: UInt64[np.ndarray, " windows"], start: Int32[np.ndarray, " windows"]
) -> Float64[np.ndarray, " windows"]:
    """Return a number in [0, 1) for each window: a hash of its episode's identity and its first step.

    Source: Steele, Lea, Flood (2014), SplitMix64 (constants of Stafford's variant 13).
    """
    value = id_hash + (start.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    value ^= value >> np.uint64(31)
    return (value >> np.uint64(11)) / float(1 << 53)
