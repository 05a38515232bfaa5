"""Clip windows: which clips exist, the split they belong to, and their order.

Everything here is a pure function of the episodes' identities and remaining steps, the seed and a position: nothing
depends on the number of shards, workers or ranks, and resuming a run needs no saved state.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Int32, Int64, UInt64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.clips.permutation import permuted
from vjepa2_ac.data.clips.splits import in_split
from vjepa2_ac.data.filters.exclusion import NAMED, named
from vjepa2_ac.data.filters.step_ranges import ClipStarts
from vjepa2_ac.data.index import EpisodeTable
from vjepa2_ac.errors import InputError

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Windows:
    """Every clip of a split, in the order of the episodes' identities, then of the starts; as runs of neighbours."""

    starts: ClipStarts
    ends: Int64[np.ndarray, " runs"]  # windows up to and including each run
    short: Int32[np.ndarray, " short"]  # episodes skipped because they are shorter than a clip
    id_hash: UInt64[np.ndarray, " episodes"]
    keep_share: float  # of the idle windows

    def __len__(self) -> int:
        return int(self.ends[-1])

    def __getitem__(self, index: int) -> tuple[int, int]:
        """Return (episode, first control step) of a window."""
        if not 0 <= index < len(self):
            raise IndexError(f"window {index} of {len(self)}")
        run = int(np.searchsorted(self.ends, index, side="right"))
        place = index - (int(self.ends[run]) - int(self.starts.count[run]))
        steps = self.starts.steps_of(run, self.id_hash, self.keep_share)
        return int(self.starts.episode[run]), int(steps[place])

    @property
    def episodes(self) -> Int32[np.ndarray, " episodes"]:
        """The episodes that clips come from; an index into the source."""
        return self.starts.episodes


@dataclass(frozen=True)
class ClipOrder:
    """The endless order of training: every window once per epoch, each epoch in its own order."""

    windows: Windows
    seed: int

    def window(self, position: int) -> tuple[int, int]:
        """Return (episode, first control step) of the clip at a position of the run."""
        epoch, index = divmod(position, len(self.windows))
        return self.windows[permuted(index, size=len(self.windows), seed=self.seed, epoch=epoch)]

    def choice(self, position: int, count: int) -> int:
        """Return one of `range(count)`, uniformly drawn, for the clip at a position of the run."""
        digest = hashlib.blake2b(f"{self.seed} {position}".encode(), digest_size=8).digest()
        return int.from_bytes(digest, "big") % count


def windows_of(
    table: EpisodeTable,
    taking_part: Bool[np.ndarray, " episodes"],
    starts: ClipStarts,
    config: DataConfig,
    split: Split,
    split_hash: UInt64[np.ndarray, " episodes"],
) -> Windows:
    """Return the windows of a split.

    Args:
        table: The episodes.
        taking_part: Which of them are used.
        starts: The result of `clip_starts` for all of these.
        config: Shares of the splits, and what to do with short episodes.
        split: Which split.
        split_hash: The hash that determines the split of each episode.

    Raises:
        InputError: The split has no episodes, or only short ones, or none with a clip's length of kept steps, or
            `data.short_episodes` forbids short ones.
    """
    members = in_split(split_hash, taking_part, config, split)
    if not members.any():
        groups = None if config.split_by is None else len(np.unique(split_hash[taking_part]))
        raise _empty_split(int(taking_part.sum()), groups, config, split)
    short = np.flatnonzero(members & (table.num_steps < config.clip_steps)).astype(np.int32)
    short = short[np.argsort(table.id_rank[short])]
    if len(short) and (config.short_episodes == "error" or len(short) == members.sum()):
        raise _too_short(table, short, int(members.sum()), config, split)
    if len(short):
        names = tuple(table.identity(int(number)) for number in short[: NAMED + 1])
        _warn_of_short(config.path, split, config.clip_steps, int(members.sum()), len(short), names)
    own = starts[members[starts.episode]]
    if not own.windows:
        raise InputError(
            where=f"data.path: {config.path}",
            found=f"no {split} episode has a range of kept steps as long as a clip (data.idle.rule {config.idle.rule})",
            needed=_length_of(config),
            fix="Lower data.frames or data.stride, raise data.idle.keep_share, or set data.idle.rule: none",
        )
    return Windows(own, np.cumsum(own.count, dtype=np.int64), short, table.id_hash, config.idle.keep_share)


def require_stride(config: DataConfig, *, to: str, fix: str = "`vjepa2-ac data calibrate CONFIG` finds one") -> int:
    """Return the stride of a config.

    Args:
        config: The data.
        to: What it is needed for.
        fix: How to say it.

    Raises:
        InputError: It is auto.
    """
    if config.stride == "auto":
        raise InputError(where="data.stride", found="auto", needed=f"a number of control steps, to {to}", fix=fix)
    return config.stride


def spread(size: int, count: int) -> list[int]:
    """Return at most `count` of `range(size)`, evenly spread, each once."""
    count = min(size, count)
    return [(2 * number + 1) * size // (2 * count) for number in range(count)]


def spread_with_ends(size: int, count: int) -> list[int]:
    """Return at most `count` of `range(size)`, evenly spread, each once, the first and the last among them."""
    return sorted({round(place) for place in np.linspace(0, size - 1, min(size, count))})


def far_neighbours(items: list[int]) -> list[int]:
    """Return sorted items in an order in which neighbours are about half the list apart."""
    half = (len(items) + 1) // 2
    pairs = itertools.zip_longest(items[:half], items[half:])
    return [item for pair in pairs for item in pair if item is not None]


@lru_cache(maxsize=64)  # logged once: every validation uses the same windows
def _warn_of_short(path: str, split: Split, clip_steps: int, members: int, short: int, names: tuple[str, ...]) -> None:
    logger.warning(
        "%s: %d of %d %s episodes are shorter than a clip of %d control steps and left out: %s",
        path, short, members, split, clip_steps, named(names, short),
    )  # fmt: skip


def _empty_split(episodes: int, groups: int | None, config: DataConfig, split: Split) -> InputError:
    shares = f"validation_share {config.validation_share:g}, test_share {config.test_share:g}"
    members = "episodes" if groups is None else "groups"
    fix = (
        "Lower data.validation_share or data.test_share"
        if split == "train"
        else f"Raise data.{split}_share: above 0, three {members} or more always have one"
    )
    together = "" if groups is None else f" in {groups} groups (data.split_by)"
    return InputError(
        where=f"data.path: {config.path}",
        found=f"no {split} episodes among {episodes}{together} ({shares})",
        needed="one or more",
        fix=fix,
    )


def _too_short(
    table: EpisodeTable, short: Int32[np.ndarray, " short"], members: int, config: DataConfig, split: Split
) -> InputError:
    longest = int(short[np.argmax(table.num_steps[short])])
    everyone = len(short) == members
    fix = "Lower data.frames or data.stride" + ("" if everyone else ", or set data.short_episodes: skip")
    names = [table.identity(int(number)) for number in short[:NAMED]]
    return InputError(
        where=f"data.path: {config.path}",
        found=f"{len(short)} of {members} {split} episodes are shorter than a clip; the longest of these,"
        f" {table.identity(longest)}, has {table.num_steps[longest]} steps. Too short: {named(names, len(short))}",
        needed=_length_of(config),
        fix=fix,
    )


def _length_of(config: DataConfig) -> str:
    return f"{config.clip_steps} steps for a clip of {config.frames} frames at stride {config.stride}"
