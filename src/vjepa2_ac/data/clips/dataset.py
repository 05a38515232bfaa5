"""The data set of a run: its episodes and steps, opened and filtered once, small enough to send to every worker."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, UInt64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.clips.actions import widths_of
from vjepa2_ac.data.clips.splits import in_split
from vjepa2_ac.data.clips.windows import Windows, windows_of
from vjepa2_ac.data.filters.broken_episodes import BrokenEpisodes
from vjepa2_ac.data.filters.exclusion import included, with_way_out
from vjepa2_ac.data.filters.grouping import split_hash
from vjepa2_ac.data.filters.idle_ranges import FoundRanges, find_ranges
from vjepa2_ac.data.filters.step_ranges import ClipStarts, StepSelection, clip_starts
from vjepa2_ac.data.index import EpisodeTable
from vjepa2_ac.data.sources.configured_spaces import spaces_of
from vjepa2_ac.data.sources.latents.source import LatentSource
from vjepa2_ac.data.sources.registry import open_source
from vjepa2_ac.episode import POSE_WIDTHS, EpisodeSource, Progress, StepRanges, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import Spaces

logger = logging.getLogger(__name__)

_MOST_EPISODES_READ = 8  # to find the widths, if some are broken


@dataclass(frozen=True)
class Removed:
    """What a filter removed, after the previous filters."""

    name: str  # excluded, broken, outcome, idle
    episodes: int  # without remaining steps
    steps: int  # of episodes that could be read
    windows: int | None  # clips; None while data.stride is auto
    stays: float = 0.0  # share of the clips from these steps that are still used (data.idle.keep_share)

    def __str__(self) -> str:
        clips = "" if self.windows is None else f", {self.windows:,} clips"
        stays = f" ({self.stays:.0%} of the clips from these stay)" if self.stays else ""
        return f"{self.episodes:,} episodes, {self.steps:,} steps{clips}{stays}"


@dataclass(frozen=True, eq=False)
class Dataset:
    """An open data set: its episodes, and the steps that the config selects. Can be pickled to a loader worker."""

    config: DataConfig
    source: EpisodeSource
    table: EpisodeTable
    kept: StepSelection
    broken: BrokenEpisodes  # grows in the process that opened the set
    groups: UInt64[np.ndarray, " episodes"] | None = None  # hash of each one's group; None: `data.split_by` names none

    @property
    def split_hash(self) -> UInt64[np.ndarray, " episodes"]:
        """The hashes that determine the split of each episode."""
        return self.table.id_hash if self.groups is None else self.groups

    def members(self, split: Split) -> Bool[np.ndarray, " episodes"]:
        """Return which episodes are used and belong to a split."""
        return in_split(self.split_hash, self.kept.taking_part, self.config, split)

    def windows(self, split: Split) -> Windows:
        """Return the clips of a split.

        Raises:
            InputError: There are none; see `windows_of`.
        """
        return windows_of(self.table, self.kept.taking_part, self.starts, self.config, split, self.split_hash)

    def with_stride(self, stride: int) -> Dataset:
        """Return the data set with another stride.

        Raises:
            InputError: The data is a latent cache, which has the frames of one stride only.
        """
        if self.config.is_cache and stride != self.config.stride:
            raise InputError(
                where=self.config.path,
                found=f"latents that were encoded for clips at stride {self.config.stride}",
                needed=f"stride {stride}",
                fix="Use the data set itself, with data.cache: off",
            )
        return replace(self, config=self.config.with_stride(stride))

    @cached_property
    def removed(self) -> tuple[Removed, ...]:
        """What each filter removed, in their order."""
        included_ones = included(self.table, self.config)
        of_outcome = included_ones & _of_outcome(self.table, self.config)
        excluded = sum(problem.name in self.config.exclude for problem in self.table.problems)
        unread = {"excluded": excluded, "broken": len(self.table.problems) - excluded}
        stays = {"idle": self.config.idle.keep_share}
        everyone = np.ones(len(self.table), bool)
        stages = {"excluded": everyone, "outcome": included_ones, "broken": of_outcome, "idle": self.kept.taking_part}
        left = [self._count(StepSelection.whole(self.table, mask)) for mask in stages.values()]
        gone = -np.diff([*left, self._count(self.kept)], axis=0)
        is_known = self.config.stride != "auto"
        return tuple(
            Removed(name, count + unread.get(name, 0), steps, windows if is_known else None, stays.get(name, 0.0))
            for name, (count, steps, windows) in zip(stages, gone.tolist(), strict=True)
        )

    def _count(self, kept: StepSelection) -> tuple[int, int, int]:
        """Return the numbers of episodes, steps and, if the stride is known, windows."""
        windows = 0
        if self.config.stride != "auto":
            starts = self.starts if kept is self.kept else clip_starts(self.table, kept, self.config)
            windows = starts.windows
        episodes = self.episodes if kept is self.kept else np.unique(kept.episode)
        return len(episodes), kept.steps, windows

    @property
    def episodes(self) -> Int[np.ndarray, " episodes"]:
        """The episodes that clips may come from."""
        if self.config.idle.rule != "none" and self.config.idle.keep_share > 0:
            return np.flatnonzero(self.kept.taking_part)
        return np.unique(self.kept.episode)

    @cached_property
    def starts(self) -> ClipStarts:
        """The first steps of the clips of all splits.

        Raises:
            ValueError: The stride is not yet calibrated.
        """
        return clip_starts(self.table, self.kept, self.config)

    @cached_property
    def control_rate_hz(self) -> float:
        """Control steps per second: of the whole data set if the source knows it, else of its first episode."""
        rate = self.table.texts.get("control_rate_hz")
        return float(rate) if rate is not None else self.source.read(int(self.episodes[0])).control_rate_hz

    @cached_property
    def spaces(self) -> Spaces:
        """The spaces of its states and actions."""
        return spaces_of(self.config, self.widths)

    @cached_property
    def widths(self) -> Widths:
        """The widths of states and actions: 7 for poses, else those of the first readable episode.

        Raises:
            InputError: None of the first episodes can be read.
        """
        if self.config.states == "pose":
            return POSE_WIDTHS
        if widths := self.table.texts.get("widths"):
            return Widths(*map(int, widths.split()))
        first_error: InputError | None = None
        for episode in self.episodes[:_MOST_EPISODES_READ].tolist():
            try:
                return widths_of(self.source.read(episode))
            except InputError as error:
                first_error = first_error or error
        raise first_error or ValueError("a data set without episodes")

    def leave_out(self, episode: int, error: InputError) -> None:
        """Apply `data.broken_episodes` to an episode that cannot be read: record it, or stop.

        Raises:
            InputError: The error with a fix; or, too many are broken by now.
        """
        name = self.table.identity(episode)
        if self.config.broken_episodes == "error":
            raise with_way_out(error, [name]) from None
        self.broken.met(name, str(error))

    def needed_steps(self, episode: int) -> StepRanges | None:
        """Return the steps of an episode that clips may come from; None: all of them."""
        if self.config.idle.rule == "none" or self.config.idle.keep_share > 0:
            return None
        return self.kept.of(episode)


def open_dataset(config: DataConfig, *, progress: Progress | None = None) -> Dataset:
    """Open a data set and select its episodes and steps.

    Args:
        config: Where it is, and what is excluded.
        progress: Called with (done, total) while the data set is indexed for the first time.

    Raises:
        InputError: There is no such data set; an episode is broken and `data.broken_episodes` does not skip it, or too
            many are; two episodes have one identity; a filter or `data.split_by` cannot be applied; or nothing remains.
    """
    source = open_source(config)
    table = EpisodeTable.of(source.infos(progress))
    broken = BrokenEpisodes(config, len(table) + len(table.problems))
    taking_part = included(table, config)
    _require_distinct(table, taking_part, config)
    excluded = frozenset(config.exclude)
    broken.found([problem for problem in table.problems if problem.name not in excluded])
    taking_part &= _of_outcome(table, config)
    if config.idle.rule == "none":
        kept = StepSelection.whole(table, taking_part)
    else:
        if isinstance(source, LatentSource):
            ranges = source.kept_ranges()
        else:
            ranges = find_ranges(source, table, config, progress)
        kept = _select_steps(ranges, table, taking_part, broken)
        _log_listed_episodes(ranges, table, config)
    dataset = Dataset(config, source, table, kept, broken, split_hash(table, kept.taking_part, config))
    if not len(dataset.episodes):
        raise _nothing_left(dataset)
    if isinstance(source, LatentSource):
        dataset = _of_latents(dataset, source)
    logger.info("%s: %d episodes take part, %d steps of them", config.path, kept.taking_part.sum(), kept.steps)
    return dataset


def through_latents(dataset: Dataset, folder: Path) -> Dataset:
    """Return the same data set, with the same clips in the same order, read from its latent cache.

    Raises:
        InputError: The cache lacks episodes or is damaged.
    """
    config = dataset.config.as_kind("latents", path=str(folder), cache="off", camera=dataset.config.cameras)
    source = LatentSource(config)
    return _of_latents(replace(dataset, source=source, table=source.infos()), source)


def _of_latents(dataset: Dataset, source: LatentSource) -> Dataset:
    """Check that a cache has what the clips need, and set its cameras in the config."""
    source.require_encoded(dataset.starts.episode)
    excluded = frozenset(dataset.config.exclude)
    dataset.broken.found([problem for problem in source.wrong_files() if problem.name not in excluded])
    return replace(dataset, config=source.settled_config)


def _nothing_left(dataset: Dataset) -> InputError:
    filters = ", ".join(f"{one.name} {one.episodes}" for one in dataset.removed if one.episodes)
    return InputError(
        where=f"data.path: {dataset.config.path}",
        found=f"none of {len(dataset.table) + len(dataset.table.problems)} episodes is left"
        + (f" (left out: {filters})" if filters else ""),
        needed="at least one",
        fix="Look at data.exclude, data.outcome and data.idle" if filters else "",
    )


def _select_steps(
    found: FoundRanges, table: EpisodeTable, taking_part: Bool[np.ndarray, " episodes"], broken: BrokenEpisodes
) -> StepSelection:
    met = [(place, problem) for place, problem in found.problems if taking_part[place]]
    broken.found([problem for _, problem in met])
    taking_part[[place for place, _ in met]] = False
    everything = StepSelection(found.episode, found.start, found.end, np.ones(len(table), bool))
    return everything.only(taking_part)


def _of_outcome(table: EpisodeTable, config: DataConfig) -> Bool[np.ndarray, " episodes"]:
    if config.outcome == "all":
        return np.ones(len(table), bool)
    if len(table) and (table.success < 0).all():
        raise InputError(
            where=f"data.outcome: {config.outcome}",
            found=f"no episode of {config.path} says whether it succeeded",
            needed="at least some that do",
            fix="Set data.outcome: all",
        )
    return np.asarray(table.success == (config.outcome == "success"))


def _log_listed_episodes(found: FoundRanges, table: EpisodeTable, config: DataConfig) -> None:
    if config.idle.rule != "published":
        return
    logger.log(
        logging.INFO if found.listed == len(table) else logging.WARNING,
        "%s: knows %d of the %d episodes; the other %d count as idle",
        config.idle.ranges, found.listed, len(table), len(table) - found.listed,
    )  # fmt: skip


def _require_distinct(table: EpisodeTable, taking_part: Bool[np.ndarray, " episodes"], config: DataConfig) -> None:
    """Refuse two episodes with one identity: they would share a split, and an error could not name one of them."""
    order = np.argsort(table.id_hash, kind="stable")
    order = order[taking_part[order]]
    hashes = table.id_hash[order]
    for place in np.flatnonzero(hashes[1:] == hashes[:-1]):
        first, second = sorted((int(order[place]), int(order[place + 1])))
        if table.identity(first) == table.identity(second):
            error = InputError(
                where=f"data.path: {config.path}",
                found=f"episodes {first} and {second} have the same identity: {table.identity(first)}",
                needed="episodes that can be told apart: the split is a hash of the identity",
                fix=config.same_identity_fix,
            )
            raise with_way_out(error, [table.identity(first)], skippable=False)
