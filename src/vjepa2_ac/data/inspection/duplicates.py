"""Duplicates: an episode under several names, which could be in both the training and the validation split."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from vjepa2_ac.config.data import Split
from vjepa2_ac.data.clips.dataset import Dataset
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
    members = np.flatnonzero(dataset.kept.taking_part & (table.state_hash != UNKNOWN))
    members = members[np.argsort(table.id_rank[members])]
    _, first, group, count = np.unique(
        table.state_hash[members], return_index=True, return_inverse=True, return_counts=True
    )
    is_copy = count[group] > 1
    if not is_copy.any():
        return Duplicates(is_known=True)
    splits = _splits(dataset, members)
    is_across = _is_across(splits, group)
    chosen = int(np.argmax(is_across if is_across.any() else is_copy))
    twins = np.flatnonzero((group == group[chosen]) & (np.arange(len(members)) != chosen))
    twin = int(twins[np.argmax(splits[twins] != splits[chosen])])
    is_first = np.zeros(len(members), bool)
    is_first[first] = True
    return Duplicates(
        is_known=True,
        episodes=int(is_copy.sum()),
        different=int((count > 1).sum()),
        across=int(is_across.sum()),
        example=tuple((table.identity(int(members[place])), _SPLITS[splits[place]]) for place in (chosen, twin)),
        copies=tuple(table.identity(int(member)) for member in members[~is_first]),
    )


def _splits(dataset: Dataset, members: Int[np.ndarray, " members"]) -> Int[np.ndarray, " members"]:
    """Return the split of each, as an index into `_SPLITS`."""
    return np.asarray(np.argmax([dataset.members(split)[members] for split in _SPLITS], axis=0))


def _is_across(splits: Int[np.ndarray, " members"], group: Int[np.ndarray, " members"]) -> Bool[np.ndarray, " members"]:
    least = np.full(group.max() + 1, len(_SPLITS))
    most = np.full(group.max() + 1, -1)
    np.minimum.at(least, group, splits)
    np.maximum.at(most, group, splits)
    return np.asarray((least != most)[group])
