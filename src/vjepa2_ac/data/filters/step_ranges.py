"""Step ranges that clips may come from: a few bytes per episode, and the clip starts that fit into them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int, Int32, UInt64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.index import EpisodeTable
from vjepa2_ac.episode import StepRanges

_WINDOWS_AT_ONCE = 1 << 17  # idle windows that are drawn at once


@dataclass(frozen=True, eq=False)
class StepSelection:
    """Ranges [start, end) of control steps that a clip must fit into; by episode, then ascending and disjoint."""

    episode: Int32[np.ndarray, " ranges"]  # index into the table
    start: Int32[np.ndarray, " ranges"]
    end: Int32[np.ndarray, " ranges"]
    taking_part: Bool[np.ndarray, " episodes"]  # an episode may be used although none of its steps is kept

    @classmethod
    def whole(cls, table: EpisodeTable, taking_part: Bool[np.ndarray, " episodes"]) -> StepSelection:
        """Keep every step of the used episodes."""
        episode = np.flatnonzero(taking_part).astype(np.int32)
        return cls(episode, np.zeros(len(episode), np.int32), table.num_steps[episode], taking_part)

    def only(self, episodes: Bool[np.ndarray, " episodes"]) -> StepSelection:
        """Return the selection with these episodes only."""
        stays = episodes[self.episode]
        ranges = replace(self, episode=self.episode[stays], start=self.start[stays], end=self.end[stays])
        return replace(ranges, taking_part=self.taking_part & episodes)

    def of(self, episode: int) -> StepRanges:
        """Return the ranges of one episode."""
        first, last = np.searchsorted(self.episode, np.array([episode, episode + 1], np.int32))
        return tuple(zip(self.start[first:last].tolist(), self.end[first:last].tolist(), strict=True))

    @property
    def steps(self) -> int:
        """The total number of kept steps."""
        return int((self.end.astype(np.int64) - self.start).sum())


@dataclass(frozen=True, eq=False)
class ClipStarts:
    """First steps of clips as runs of neighbours: the whole run if count is span, else those that `drawn` selected.

    Neighbours are `every` control steps apart: first, first + every, ..., span of them.
    """

    episode: Int32[np.ndarray, " runs"]
    first: Int32[np.ndarray, " runs"]
    span: Int32[np.ndarray, " runs"]
    count: Int32[np.ndarray, " runs"]
    every: int = 1

    def __getitem__(self, chosen: np.ndarray) -> ClipStarts:
        """Return some of the runs, by a mask or by index."""
        episode, first, span, count = (column[chosen] for column in self.columns)
        return ClipStarts(episode, first, span, count, self.every)

    def thinned(self, phase: Int32[np.ndarray, " episodes"], every: int) -> ClipStarts:
        """Return every n-th start of runs of neighbours: those a multiple of n from their episode's phase."""
        first = self.first + (phase[self.episode] - self.first) % every
        span = -((first - self.first - self.span) // every)  # rounded up; 0 or less if none remains
        return ClipStarts(self.episode, first, span, span, every)[span > 0]

    def steps_of(self, run: int, id_hash: UInt64[np.ndarray, " episodes"], keep_share: float) -> Int[np.ndarray, " n"]:
        """Return the starts of a run.

        Args:
            run: Its index.
            id_hash: Of all episodes.
            keep_share: Of the idle windows.
        """
        episode, first, span, count = (int(column[run]) for column in self.columns)
        steps = first + self.every * np.arange(span)
        if count == span:
            return steps
        return steps[drawn(np.repeat(id_hash[[episode]], span), steps) < keep_share]

    @property
    def columns(self) -> tuple[Int32[np.ndarray, " runs"], ...]:
        """Episode, first, span, count."""
        return self.episode, self.first, self.span, self.count

    @property
    def episodes(self) -> Int32[np.ndarray, " episodes"]:
        """The episodes that clips come from, each once, ascending."""
        return np.unique(self.episode)

    @property
    def windows(self) -> int:
        """The number of clips."""
        return int(self.count.sum(dtype=np.int64))


def clip_starts(table: EpisodeTable, kept: StepSelection, config: DataConfig) -> ClipStarts:
    """Return all clip starts, sorted by the episodes' identities: in kept steps, and in a share of the idle ones."""
    counts = kept.end - kept.start - (config.clip_steps - 1)
    fits = counts > 0
    every_step = ClipStarts(kept.episode[fits], kept.start[fits], counts[fits], counts[fits])
    every, phase = config.start_every, np.zeros(len(table), np.int32)
    phase[kept.episode[::-1]] = kept.start[::-1]  # the last write counts: an episode's first range
    runs = every_step.thinned(phase, every)
    if config.idle.rule != "none" and config.idle.keep_share > 0:
        gaps = _gaps(table, kept.taking_part, every_step, config).thinned(phase, every)
        still = _still(table, gaps, config.idle.keep_share)
        episode, first, span, count = map(np.concatenate, zip(runs.columns, still.columns, strict=True))
        runs = ClipStarts(episode, first, span, count, every)
    return runs[np.lexsort((runs.first, table.id_rank[runs.episode]))]


def _still(table: EpisodeTable, gaps: ClipStarts, keep_share: float) -> ClipStarts:
    """Return the idle windows that are kept: each is drawn by a hash of its episode's identity and its start."""
    ends = np.cumsum(gaps.span, dtype=np.int64)
    counts = np.zeros_like(gaps.span)
    cut = 0
    while cut < len(ends):  # in parts: bounds the memory
        before = int(ends[cut - 1]) if cut else 0
        upto = max(cut + 1, int(np.searchsorted(ends, before + _WINDOWS_AT_ONCE, side="right")))
        some = gaps[np.arange(cut, upto)]
        opens = ends[cut:upto] - before - some.span
        place = np.arange(int(some.span.sum())) - np.repeat(opens, some.span)  # within its gap
        start = np.repeat(some.first, some.span) + gaps.every * place
        stays = drawn(table.id_hash[np.repeat(some.episode, some.span)], start) < keep_share
        counts[cut:upto] = np.add.reduceat(stays, opens, dtype=np.int32)
        cut = upto
    return replace(gaps, count=counts)[counts > 0]


def _gaps(
    table: EpisodeTable, taking_part: Bool[np.ndarray, " episodes"], runs: ClipStarts, config: DataConfig
) -> ClipStarts:
    """Return the starts from which a clip fits into its episode, but into none of its kept ranges."""
    windows = table.num_steps - (config.clip_steps - 1)
    members = np.flatnonzero(taking_part & (windows > 0)).astype(np.int32)
    episode = np.concatenate([runs.episode, members])  # an empty run ends each episode
    first = np.concatenate([runs.first, windows[members]])
    after = first + np.concatenate([runs.span, np.zeros_like(members)])
    order = np.lexsort((first, episode))
    episode, first, after = episode[order], first[order], after[order]
    begin = np.zeros_like(first)
    begin[1:] = np.where(episode[1:] == episode[:-1], after[:-1], 0)
    span = first - begin
    return ClipStarts(episode, begin, span, span)[span > 0]


def drawn(
    id_hash: UInt64[np.ndarray, " windows"], start: Int[np.ndarray, " windows"]
) -> Float64[np.ndarray, " windows"]:
    """Return a number in [0, 1) for each window: a hash of its episode's identity and its first step.

    Source: Steele, Lea, Flood (2014), SplitMix64 (constants of Stafford's variant 13).
    """
    value = id_hash + (start.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    value ^= value >> np.uint64(31)
    return np.asarray((value >> np.uint64(11)) / float(1 << 53))
