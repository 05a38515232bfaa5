"""The split that each episode belongs to: as the data set has it, or drawn by a hash of the episode's identity."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, UInt64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.index import EpisodeTable, Labels
from vjepa2_ac.errors import counted

SPLIT = "split"  # label of an episode: the name of its split in the data set

_HELD_OUT: tuple[Split, ...] = ("validation", "test")
_ROLES: dict[str, Split] = {"val": "validation", "valid": "validation", "validation": "validation", "test": "test"}
_FEWEST_GROUPS = 3  # one for each split

Members = Bool[np.ndarray, " episodes"]


def roles_of(names: Iterable[str]) -> dict[str, Split]:
    """Return as which of our splits each split of a data set is used, by its name.

    An unknown name counts as train. The result is empty unless the data set has both a split to train on and a split
    that is held out.
    """
    roles = {name: _ROLES.get(name.lower(), "train") for name in names}
    return roles if "train" in roles.values() and len(set(roles.values())) > 1 else {}


def with_own_splits(table: EpisodeTable, names: Sequence[str | None]) -> EpisodeTable:
    """Return the table with the name of each episode's split as a label, if the data set has several splits."""
    labels = Labels.of(names)
    return table if len(labels.names) < 2 else replace(table, labels={**table.labels, SPLIT: labels})


def held_out_by(table: EpisodeTable, config: DataConfig) -> dict[Split, Members]:
    """Return the episodes of validation and test where the data set has such splits and `data.splits` uses them."""
    labels = table.labels.get(SPLIT)
    if labels is None or config.splits == "hash":
        return {}
    roles = roles_of(labels.names)
    numbers = {split: [n for n, name in enumerate(labels.names) if roles.get(name) == split] for split in _HELD_OUT}
    return {split: np.isin(labels.number, of_split) for split, of_split in numbers.items() if of_split}


def describe_splits(table: EpisodeTable, config: DataConfig) -> str:
    """Return how the data set's own splits are used, as text; empty if the data set has only one split."""
    labels = table.labels.get(SPLIT)
    if labels is None:
        return ""
    counts = np.bincount(labels.number[labels.number >= 0], minlength=len(labels.names)).tolist()
    named = [f"{name} ({counted(count, 'episode')})" for name, count in zip(labels.names, counts, strict=True)]
    if not (held_out := held_out_by(table, config)):
        why = "data.splits is hash" if config.splits == "hash" else "no train beside val, validation or test"
        return f"drawn by hash from all of the data set's own, {', '.join(named)}: {why}"
    roles = zip(named, roles_of(labels.names).items(), strict=True)
    used = ", ".join(text if name == role else f"{text} as {role}" for text, (name, role) in roles)
    drawn = next((f"; {split} is drawn from train by hash" for split in _HELD_OUT if split not in held_out), "")
    return f"the data set's own: {used}{drawn}"


def members_of(
    table: EpisodeTable, split_hash: UInt64[np.ndarray, " episodes"], config: DataConfig, split: Split, among: Members
) -> Members:
    """Return which episodes belong to a split: those of the data set's own, or drawn from the others by `in_split`.

    Args:
        table: The episodes, with the names of the data set's own splits.
        split_hash: As for `in_split`.
        config: `data.splits` and the shares; the share of a split that the data set has is not used.
        split: Which split.
        among: As for `in_split`.
    """
    held_out = held_out_by(table, config)
    if split in held_out:
        return np.asarray(among & held_out[split])
    shares = {f"{own}_share": 0.0 for own in held_out}
    left = among & ~np.any([*held_out.values()], axis=0) if held_out else among
    return in_split(split_hash, config.model_copy(update=shares), split, left)


def in_split(
    split_hash: UInt64[np.ndarray, " episodes"],
    config: DataConfig,
    split: Split,
    among: Bool[np.ndarray, " episodes"] | None = None,
) -> Bool[np.ndarray, " episodes"]:
    """Return which episodes belong to a split.

    The hash, as a number in [0, 1), is compared with the shares. Where that leaves validation or test without any,
    as may happen to few episodes, though its share is above 0, the one whose number comes next moves there.

    Args:
        split_hash: Of each episode's identity; with `data.split_by`, of the name of its group.
        config: The shares.
        split: Which split.
        among: Which of them are split, None: all. The split of one depends on the others where these are few: so they
            are the same throughout a run, with those that are broken or left out by `data.exclude`.
    """
    number = split_hash.astype(np.float64) / 2**64
    among = np.ones(len(number), bool) if among is None else among
    test, held_out = _bounds(np.unique(number[among]), config)
    low, high = {"test": (0.0, test), "validation": (test, held_out), "train": (held_out, 2.0)}[split]
    return np.asarray(among & (number >= low) & (number < high))


def _bounds(groups: Float[np.ndarray, " groups"], config: DataConfig) -> tuple[float, float]:
    """Return the numbers below which a group is of test, and of test or validation; `groups` has all, sorted."""
    test, held_out = config.test_share, config.test_share + config.validation_share
    if len(groups) < _FEWEST_GROUPS:
        return test, held_out
    if config.test_share > 0 and not (groups < test).any():
        test = float(np.nextafter(groups[0], 2.0))
    held_out = max(test, held_out)
    left = groups[groups >= test]
    if config.validation_share > 0 and len(left) > 1 and not (left < held_out).any():
        held_out = float(np.nextafter(left[0], 2.0))
    return test, held_out
