"""Findings: the lines of `data check`, and their summary; and duplicates, which are found by the index alone."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Int, UInt64
from scipy.spatial import KDTree

from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.index import SPANS, UNKNOWN, EpisodeTable
from vjepa2_ac.errors import counted

Level = Literal["ok", "warning", "error", "skipped"]
DUPLICATES_FIX = "List copies in data.exclude, or keep related episodes in one split with data.split_by"
SPLITS: tuple[Split, ...] = ("train", "validation", "test")

_NEAR = 1e-4  # of means and deviations of copies: rounding to 0.1 mm changes them less
_MOVING = 1e-2  # of deviations: episodes with smaller ones may agree because the robot stands still
_MOST_COPIES = 8  # of one recording; of more, not all may be found


@dataclass(frozen=True)
class Finding:
    """The result of one check of a data set.

    An error: training would not start, or learn nothing. A warning: something is probably wrong. Skipped: the check did
    not run, or could not decide; the text says what it needs.
    """

    level: Level
    about: str  # the name of the check
    text: str


def first_case(about: str, text: str, *cases: tuple[bool, Level, str]) -> Finding:
    """Return the finding of the first case that holds, with its level and explanation; `ok` if none holds."""
    level, words = next(((level, words) for holds, level, words in cases if holds), ("ok", ""))
    return Finding(level, about, f"{text}: {words}" if words else text)


def findings_as_dict(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the findings as plain values, with the number of errors, warnings and skipped checks."""
    counts = Counter(one.level for one in findings)
    return {
        "findings": [{"level": one.level, "name": one.about, "text": one.text} for one in findings],
        "errors": counts["error"],
        "warnings": counts["warning"],
        "skipped": counts["skipped"],
    }


def summary_of(findings: Sequence[Finding]) -> str:
    """Return the last line of `data check`, such as "0 errors, 1 warning, 3 skipped"."""
    counts = Counter(one.level for one in findings)
    return f"{counted(counts['error'], 'error')}, {counted(counts['warning'], 'warning')}, {counts['skipped']} skipped"


@dataclass(frozen=True)
class Duplicates:
    """Used episodes that have the same, or nearly the same, states as another one."""

    is_known: bool  # whether the states were compared
    episodes: int = 0
    different: int = 0  # of these, without copies
    across: int = 0  # of these: with a copy in another split
    example: tuple[tuple[str, Split], ...] = ()  # two of them with their splits: of different splits, if there are
    copies: tuple[str, ...] = ()  # identities of all but the first of each: what to exclude

    def __str__(self) -> str:
        if not self.is_known:
            return "need the states of the episodes; the index of this data set has none"
        if not self.episodes:
            return "no two episodes have the same states"
        (one, its_split), (other, others_split) = self.example
        return (
            f"{self.episodes:,} episodes have the states of another episode, exactly or nearly"
            f" ({self.different:,} different recordings). {self.across:,} of them have a copy in another split, such as"
            f" {one} ({its_split}) and {other} ({others_split}). {DUPLICATES_FIX}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return this as plain values, for `inspect.json`."""
        return vars(self) | {"example": [name for name, _ in self.example]}


def find_duplicates(dataset: Dataset) -> Duplicates:
    """Compare the states of all used episodes by their hashes and summaries: fast, reads nothing."""
    table = dataset.table
    if table.state_hash is None:
        return Duplicates(is_known=False)
    members = np.flatnonzero(dataset.taking_part & (table.state_hash != UNKNOWN))
    members = members[np.argsort(table.id_rank[members])]
    recordings = _recordings(table, members, table.state_hash[members])
    is_copied = np.bincount(recordings)[recordings] > 1
    members, recordings = members[is_copied], recordings[is_copied]
    if not len(members):
        return Duplicates(is_known=True)
    splits = np.argmax([dataset.members(split)[members] for split in SPLITS], axis=0)
    groups: dict[int, list[tuple[str, Split]]] = defaultdict(list)
    for number, member, split in zip(recordings.tolist(), members.tolist(), splits.tolist(), strict=True):
        groups[number].append((table.identity(member), SPLITS[split]))
    across = [group for group in groups.values() if len({split for _, split in group}) > 1]
    first, *others = (across or list(groups.values()))[0]
    other = next((one for one in others if one[1] != first[1]), others[0])
    return Duplicates(
        is_known=True,
        episodes=len(members),
        different=len(groups),
        across=sum(map(len, across)),
        example=(first, other),
        copies=tuple(name for group in groups.values() for name, _ in group[1:]),
    )


def _recordings(
    table: EpisodeTable, members: Int[np.ndarray, " members"], hashes: UInt64[np.ndarray, " members"]
) -> Int[np.ndarray, " members"]:
    """Return a number for each episode: the same for equal and for nearly equal states."""
    motion = table.motion[members]
    numbers = np.unique(hashes, return_inverse=True)[1]
    moving = np.flatnonzero(motion[:, SPANS].max(axis=1, initial=0.0) > _MOVING)  # not those of unknown motion
    points = np.column_stack([motion[moving, 2:], table.num_steps[members[moving]]])
    _, nearest = KDTree(points).query(points, k=_MOST_COPIES, p=np.inf, distance_upper_bound=_NEAR)
    numbers[moving] = np.append(numbers[moving], len(members))[nearest].min(axis=1)  # the last one: no such neighbour
    return np.asarray(numbers)


def duplicates_finding(dataset: Dataset) -> Finding:
    """Return whether episodes are copies of others, by the index."""
    duplicates = find_duplicates(dataset)
    level: Level = "skipped" if not duplicates.is_known else "warning" if duplicates.episodes else "ok"
    return Finding(level, "duplicates", str(duplicates))
