"""Duplicates: an episode under several names, which could be in both the training and the validation split."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.index import UNKNOWN

_SPLITS: tuple[Split, ...] = ("train", "validation", "test")
WAY_OUT = "Leave copies out with data.exclude, or keep in one split what belongs together with data.split_by"


@dataclass(frozen=True)
class Duplicates:
    """Used episodes that have the same states as another one."""

    is_known: bool  # whether the states were compared
    episodes: int = 0
    different: int = 0  # of these, without copies
    across: int = 0  # of these: with a copy in another split
    example: tuple[tuple[str, Split], ...] = ()  # two of them with their splits: of different splits, if there are
    copies: tuple[str, ...] = ()  # identities of all but the first of each: what to exclude

    def __str__(self) -> str:
        if not self.is_known:
            return "not known: this data was indexed without its states"
        if not self.episodes:
            return "no two episodes have the same states"
        (one, its_split), (other, others_split) = self.example
        return (
            f"{self.episodes:,} episodes have the states of another one: they are {self.different:,} different ones."
            f" {self.across:,} of them have a copy in another split, such as"
            f" {one} ({its_split}) and {other} ({others_split}). {WAY_OUT}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return this as plain values, for `inspect.json`."""
        return vars(self) | {"example": [name for name, _ in self.example]}


def find_duplicates(dataset: Dataset) -> Duplicates:
    """Compare the states of all used episodes by their hashes: fast, reads nothing."""
    table = dataset.table
    if table.state_hash is None:
        return Duplicates(is_known=False)
    members = np.flatnonzero(dataset.taking_part & (table.state_hash != UNKNOWN))
    members = members[np.argsort(table.id_rank[members])]
    hashes, count = np.unique(table.state_hash[members], return_counts=True)
    members = members[np.isin(table.state_hash[members], hashes[count > 1])]
    if not len(members):
        return Duplicates(is_known=True)
    splits = np.argmax([dataset.members(split)[members] for split in _SPLITS], axis=0)
    groups: dict[int, list[tuple[str, Split]]] = defaultdict(list)
    for member, split in zip(members.tolist(), splits.tolist(), strict=True):
        groups[int(table.state_hash[member])].append((table.identity(member), _SPLITS[split]))
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
