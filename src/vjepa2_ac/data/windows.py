"""Clip windows: the set of all clips, and their order.

All results are pure functions of the episodes' identities and selected steps, the seed and a position. They do not
depend on the number of shards, workers or ranks, so a run can be resumed without a saved state of the loader.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Bool, Int, Int32, Int64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.index import EpisodeTable, StepSelection
from vjepa2_ac.data.selection import MAX_NAMED, format_identities
from vjepa2_ac.errors import InputError, counted

logger = logging.getLogger(__name__)

_ROUNDS = 8  # rounds of the Feistel network
_MIN_HALF_BITS = 3  # bits in half of an index; with fewer bits not all orders of few windows are equally likely
_MASK64 = (1 << 64) - 1


@dataclass(frozen=True, eq=False)
class Windows:
    """The windows of clips, sorted by the identity of the episode and then by the start, stored as runs.

    A run has `count` clips, which start at `first`, `first` + `every`, ...
    """

    episode: Int32[np.ndarray, " runs"]  # index into the source
    first: Int32[np.ndarray, " runs"]  # first control step of the first clip
    count: Int32[np.ndarray, " runs"]  # number of clips
    every: int = 1  # control steps between the starts of consecutive clips
    short: tuple[int, ...] = ()  # episodes that are skipped because they are shorter than a clip

    def select(self, runs: np.ndarray) -> Windows:
        """Select runs by a mask or by indices."""
        return replace(self, episode=self.episode[runs], first=self.first[runs], count=self.count[runs])

    @cached_property
    def _ends(self) -> Int64[np.ndarray, " runs"]:
        return np.cumsum(self.count, dtype=np.int64)

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> tuple[int, int]:
        """Return (episode, first control step) of a window."""
        if not 0 <= index < len(self):
            raise IndexError(f"window {index} of {len(self)}")
        run = int(np.searchsorted(self._ends, index, side="right"))
        offset = index - (int(self._ends[run]) - int(self.count[run]))
        return int(self.episode[run]), int(self.first[run]) + self.every * offset

    def steps_of(self, run: int) -> Int[np.ndarray, " n"]:
        """Return the first control steps of all clips of a run."""
        return int(self.first[run]) + self.every * np.arange(self.count[run])

    @property
    def episodes(self) -> Int32[np.ndarray, " episodes"]:
        """The distinct episodes that clips come from, ascending."""
        return np.unique(self.episode)


def find_clip_windows(table: EpisodeTable, selected_steps: StepSelection, config: DataConfig) -> Windows:
    """Return the windows of all clips that fit into the selected ranges of steps.

    With `data.start_every` = n, clips start at every n-th step, counted from the first selected step of their episode.
    """
    num_starts = selected_steps.end - selected_steps.start - (config.clip_steps - 1)  # for `data.start_every` = 1
    first_steps = np.zeros(len(table), np.int32)  # first selected step of each episode
    # In reverse order, so that the first range of an episode is written last.
    first_steps[selected_steps.episode[::-1]] = selected_steps.start[::-1]
    skipped = (first_steps[selected_steps.episode] - selected_steps.start) % config.start_every
    count = -((skipped - num_starts) // config.start_every)  # rounded up; 0 or less if no clip fits
    runs = Windows(selected_steps.episode, selected_steps.start + skipped, count, config.start_every).select(count > 0)
    return runs.select(np.lexsort((runs.first, table.id_rank[runs.episode])))


def select_split_windows(
    table: EpisodeTable, members: Bool[np.ndarray, " episodes"], starts: Windows, config: DataConfig, split: Split
) -> Windows:
    """Return the windows of a split.

    Args:
        table: The episodes.
        members: Mask of the episodes that are used and belong to the split; at least one.
        starts: The windows of these and other episodes, from `find_clip_windows`.
        config: The length of a clip.
        split: The name of the split.

    Raises:
        InputError: All episodes of the split are shorter than a clip, or no range of kept steps is long enough.
    """
    where, count = f"data.path: {config.path}", int(members.sum())
    length = f"{counted(config.clip_steps, 'step')} for a clip of {config.frames} frames at stride {config.stride}"
    short = np.flatnonzero(members & (table.num_steps < config.clip_steps)).astype(np.int32)
    short = short[np.argsort(table.id_rank[short])]
    if len(short) == count:
        longest = int(short[np.argmax(table.num_steps[short])])
        problem = f"all {count} {split} episodes are shorter than a clip; the longest,"
        problem += f" {table.identity(longest)}, has {counted(table.num_steps[longest], 'step')}"
        raise InputError(where=where, found=problem, needed=length, fix="Lower data.frames or data.stride")
    if len(short):
        names = tuple(table.identity(index) for index in short[: MAX_NAMED + 1].tolist())
        text = f"{config.path}: {len(short)} of {count} {split} episodes are shorter than a clip of {config.clip_steps}"
        _warn_once(f"{text} control steps and are skipped: {format_identities(names, len(short))}")
    windows = starts.select(members[starts.episode])
    if not len(windows):
        problem = f"no {split} episode has a range of kept steps as long as a clip (data.idle.rule {config.idle.rule})"
        fix = "Lower data.frames or data.stride, or set data.idle.rule: none"
        raise InputError(where=where, found=problem, needed=length, fix=fix)
    return replace(windows, short=tuple(short.tolist()))


@lru_cache(maxsize=64)  # each text is logged once, although every validation requests the same windows
def _warn_once(text: str) -> None:
    logger.warning("%s", text)


@dataclass(frozen=True)
class ClipOrder:
    """The endless order of training: every window once per epoch, in a different order in each epoch."""

    windows: Windows
    seed: int

    def window(self, position: int) -> tuple[int, int]:
        """Return (episode, first control step) of the clip at a position of the run."""
        epoch, index = divmod(position, len(self.windows))
        return self.windows[permute_index(index, size=len(self.windows), seed=self.seed, epoch=epoch)]

    def draw_index(self, position: int, count: int) -> int:
        """Draw an index from `range(count)` uniformly for the clip at a position of the run."""
        digest = hashlib.blake2b(f"{self.seed} {position}".encode(), digest_size=8).digest()
        return int.from_bytes(digest, "big") % count


def permute_index(index: int, *, size: int, seed: int, epoch: int) -> int:
    """Return the index to which a pseudo-random permutation of `range(size)` maps an index.

    Each seed and epoch has another permutation, which is computed without storing it: a Feistel network permutes the
    range up to the next power of four, and results outside `range(size)` are permuted again until they are inside.
    """
    half = max(_MIN_HALF_BITS, ((size - 1).bit_length() + 1) // 2)
    keys = _round_keys(size, seed, epoch)
    index = _feistel(index, half, keys)
    while index >= size:
        index = _feistel(index, half, keys)
    return index


def _feistel(value: int, half: int, keys: tuple[int, ...]) -> int:
    mask = (1 << half) - 1
    left, right = value >> half, value & mask
    for key in keys:
        left, right = right, left ^ (_mix(right ^ key) & mask)
    return left << half | right


def _mix(value: int) -> int:
    """Hash a 64-bit integer. Source: Steele, Lea, Flood (2014), SplitMix64 (constants of Stafford's variant 13)."""
    value = (value ^ value >> 30) * 0xBF58476D1CE4E5B9 & _MASK64
    value = (value ^ value >> 27) * 0x94D049BB133111EB & _MASK64
    return value ^ value >> 31


@lru_cache(maxsize=8)
def _round_keys(size: int, seed: int, epoch: int) -> tuple[int, ...]:
    digest = hashlib.blake2b(f"{size} {seed} {epoch}".encode(), digest_size=8 * _ROUNDS).digest()
    return tuple(int.from_bytes(digest[8 * number : 8 * number + 8], "big") for number in range(_ROUNDS))


def draw_uniform(id_hash: int, start: int) -> float:
    """Return a pseudo-random number in [0, 1) for a window, from its episode's identity hash and its first step."""
    return (_mix((id_hash + (start + 1) * 0x9E3779B97F4A7C15) & _MASK64) >> 11) / (1 << 53)


def candidate_strides(control_rate_hz: float) -> tuple[int, ...]:
    """Return the strides that `data calibrate` compares: 4, 8 and 15 at 15 Hz, scaled to the control rate."""
    return tuple(sorted({max(1, round(stride * control_rate_hz / 15)) for stride in (4, 8, 15)}))


def require_stride(
    config: DataConfig, *, to: str, fix: str = "Run `vjepa2-ac data calibrate CONFIG` to choose one"
) -> int:
    """Return the stride of a config, or refuse a config whose stride is auto.

    Args:
        config: The data.
        to: What the stride is needed for, for messages.
        fix: How to set the stride, for messages.

    Raises:
        InputError: The stride is auto.
    """
    if config.stride == "auto":
        raise InputError(where="data.stride", found="auto", needed=f"a number of control steps, to {to}", fix=fix)
    return config.stride


def require_frames(config: DataConfig, *, to: str) -> None:
    """Refuse a latent cache, which has no frames except small images for display.

    Args:
        config: The data.
        to: What frames are needed for, for messages.

    Raises:
        InputError: The data are a latent cache.
    """
    if config.is_cache:
        needed = f"the data set itself, to {to}"
        raise InputError(where="data.source", found="a latent cache, which has no frames", needed=needed)


def spread_indices(size: int, count: int) -> list[int]:
    """Return at most `count` distinct indices from `range(size)`, evenly spread."""
    count = min(size, count)
    return [(2 * number + 1) * size // (2 * count) for number in range(count)]


def spread_indices_with_ends(size: int, count: int) -> list[int]:
    """Return at most `count` distinct indices from `range(size)`, evenly spread, including the first and the last."""
    return sorted({round(position) for position in np.linspace(0, size - 1, min(size, count))})


def interleave_halves(items: list[int]) -> list[int]:
    """Reorder sorted items so that consecutive items are about half the list apart."""
    half = (len(items) + 1) // 2
    pairs = itertools.zip_longest(items[:half], items[half:])
    return [item for pair in pairs for item in pair if item is not None]
