"""Findings, which are the lines of `data check`, and the search for duplicated episodes in the index."""

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

_NEAR = 1e-4  # maximum difference between the means and spans of copies; rounding to 0.1 mm changes them less
_MOVING = 1e-2  # episodes with smaller spans are not compared: they may be equal because the robot does not move
_MAX_COPIES = 8  # number of copies of one recording that are certainly found


@dataclass(frozen=True)
class Finding:
    """The result of one check of a data set.

    An error means that training would fail or learn nothing. A warning means that something is probably wrong. A
    skipped check did not run or could not decide; the text states what the check needs.
    """

    level: Level
    about: str  # the name of the check
    text: str


def first_case(about: str, text: str, *cases: tuple[bool, Level, str]) -> Finding:
    """Return the finding of the first case whose condition is true; without such a case the level is ok.

    Args:
        about: Name of the check.
        text: The measured values.
        cases: Condition, level and explanation of each case.
    """
    level, explanation = next(((level, explanation) for is_true, level, explanation in cases if is_true), ("ok", ""))
    return Finding(level, about, f"{text}: {explanation}" if explanation else text)


def findings_as_dict(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the findings as plain values, with the number of errors, warnings and skipped checks."""
    counts = Counter(finding.level for finding in findings)
    return {
        "findings": [{"level": finding.level, "name": finding.about, "text": finding.text} for finding in findings],
        "errors": counts["error"],
        "warnings": counts["warning"],
        "skipped": counts["skipped"],
    }


def summarize_findings(findings: Sequence[Finding]) -> str:
    """Return the last line of `data check`, such as "0 errors, 1 warning, 3 skipped"."""
    counts = Counter(finding.level for finding in findings)
    return f"{counted(counts['error'], 'error')}, {counted(counts['warning'], 'warning')}, {counts['skipped']} skipped"


@dataclass(frozen=True)
class Duplicates:
    """Used episodes whose states are equal or nearly equal to those of another episode."""

    is_known: bool  # whether the states were compared
    episodes: int = 0  # number of episodes with a copy
    different: int = 0  # number of different recordings among these episodes
    across: int = 0  # number of episodes with a copy in another split
    example: tuple[tuple[str, Split], ...] = ()  # two copies with their splits, if possible in different splits
    copies: tuple[str, ...] = ()  # identities of all but the first episode of each recording

    @property
    def level(self) -> Level:
        """The level of the finding: a warning if there are copies."""
        return "skipped" if not self.is_known else "warning" if self.episodes else "ok"

    def __str__(self) -> str:
        if not self.is_known:
            return "needs the states of the episodes in the index, found none"
        if not self.episodes:
            return "no two episodes have the same states"
        (first, first_split), (second, second_split) = self.example
        return (
            f"{self.episodes:,} episodes have the states of another episode, exactly or nearly"
            f" ({self.different:,} different recordings). {self.across:,} of them have a copy in another split, such as"
            f" {first} ({first_split}) and {second} ({second_split}). {DUPLICATES_FIX}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the plain values for `inspect.json`."""
        return vars(self) | {"example": [name for name, _ in self.example]}


def find_duplicates(dataset: Dataset) -> Duplicates:
    """Find duplicates among the used episodes by the hashes, means and spans of their states in the index."""
    table = dataset.table
    if table.state_hash is None:
        return Duplicates(is_known=False)
    members = np.flatnonzero(dataset.is_selected & (table.state_hash != UNKNOWN))
    members = members[np.argsort(table.id_rank[members])]
    recordings = _number_recordings(table, members, table.state_hash[members])
    is_copied = np.bincount(recordings)[recordings] > 1
    members, recordings = members[is_copied], recordings[is_copied]
    if not len(members):
        return Duplicates(is_known=True)
    splits = np.argmax([dataset.split_mask(split)[members] for split in SPLITS], axis=0)
    groups: dict[int, list[tuple[str, Split]]] = defaultdict(list)
    for number, member, split in zip(recordings.tolist(), members.tolist(), splits.tolist(), strict=True):
        groups[number].append((table.identity(member), SPLITS[split]))
    across = [group for group in groups.values() if len({split for _, split in group}) > 1]
    first, *copies = (across or list(groups.values()))[0]
    second = next((copy for copy in copies if copy[1] != first[1]), copies[0])
    return Duplicates(
        is_known=True,
        episodes=len(members),
        different=len(groups),
        across=sum(map(len, across)),
        example=(first, second),
        copies=tuple(name for group in groups.values() for name, _ in group[1:]),
    )


def _number_recordings(
    table: EpisodeTable, members: Int[np.ndarray, " members"], hashes: UInt64[np.ndarray, " members"]
) -> Int[np.ndarray, " members"]:
    """Return the number of the recording of each episode, equal for episodes with equal or nearly equal states."""
    motion = table.motion[members]
    numbers = np.unique(hashes, return_inverse=True)[1]
    moving = np.flatnonzero(motion[:, SPANS].max(axis=1, initial=0.0) > _MOVING)  # excludes unknown motion
    points = np.column_stack([motion[moving, 2:], table.num_steps[members[moving]]])
    _, nearest = KDTree(points).query(points, k=_MAX_COPIES, p=np.inf, distance_upper_bound=_NEAR)
    # KDTree returns the index len(points) for a missing neighbour, to which the appended number belongs.
    numbers[moving] = np.append(numbers[moving], len(members))[nearest].min(axis=1)
    return np.asarray(numbers)


def duplicates_finding(dataset: Dataset) -> Finding:
    """Return the finding about duplicated episodes."""
    duplicates = find_duplicates(dataset)
    return Finding(duplicates.level, "duplicates", str(duplicates))
