"""The split that each episode belongs to: as the data set has it, or drawn by a hash of its identity or its group."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, UInt64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.index import EpisodeTable, Labels, identity_hash
from vjepa2_ac.data.selection import named
from vjepa2_ac.errors import InputError, counted

SPLIT = "split"  # label of an episode: the name of its split in the data set

_HELD_OUT: tuple[Split, ...] = ("validation", "test")
_ROLES: dict[str, Split] = {"val": "validation", "valid": "validation", "validation": "validation", "test": "test"}
_FEWEST_GROUPS = 3  # one for each split

Members = Bool[np.ndarray, " episodes"]

# For DROID, whose identities contain .../LAB/success|failure/DATE/..., and for any data in folders.
IN_IDENTITY = {
    "lab": r"([^/]+)/(?:success|failure)/",
    "day": r"/(?:success|failure)/([0-9]{4}-[0-9]{2}-[0-9]{2})(?:/|$)",
    "folder": r"^(.+)/[^/]*$",
}


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
    listed = [f"{name} ({counted(count, 'episode')})" for name, count in zip(labels.names, counts, strict=True)]
    if not (held_out := held_out_by(table, config)):
        why = "data.splits is hash" if config.splits == "hash" else "no train beside val, validation or test"
        return f"drawn by hash from all of the data set's own, {', '.join(listed)}: {why}"
    roles = zip(listed, roles_of(labels.names).items(), strict=True)
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


def groups_of(
    table: EpisodeTable, taking_part: Bool[np.ndarray, " episodes"], config: DataConfig
) -> UInt64[np.ndarray, " episodes"] | None:
    """Return the hash of each episode's group (`data.split_by`), which determines its split; None: its identity does.

    Args:
        table: The episodes.
        taking_part: Which of them are used; the others need not belong to a group, and then get that of another one.
        config: `data.split_by`.

    Raises:
        InputError: There is no such field, one of those has none, or a pattern does not match its identity.
    """
    split_by = config.split_by
    if split_by is None:
        return None
    groups = _groups(table, split_by)
    lacking = [table.identity(place) for place in np.flatnonzero(taking_part).tolist() if not groups[place]]
    if lacking:
        from_source = split_by in table.labels
        reason = "the data set does not say it of" if from_source else "found nothing in the identities of"
        another = "choose another field" if from_source else "choose a pattern that fits every identity"
        found = f"{reason} {len(lacking)} of {counted(taking_part.sum(), 'episode')}: {named(lacking)}"
        fix = f"Leave these out with data.exclude, or {another}"
        raise InputError(where=f"data.split_by: {split_by}", found=found, fix=fix)
    hashes = {group: identity_hash(group) for group in groups if group}
    any_hash = next(iter(hashes.values()), 0)
    return np.array([hashes[group] if group else any_hash for group in groups], np.uint64)


def _groups(table: EpisodeTable, split_by: str) -> list[str | None]:
    if labels := table.labels.get(split_by):
        return [labels.of_episode(place) for place in range(len(table))]
    identities = [table.identity(place) for place in range(len(table))]
    if split_by not in IN_IDENTITY and re.fullmatch(r"[A-Za-z_]+", split_by):
        own, such = ", ".join(table.labels) or "none of its own", f", such as {identities[0]}" if identities else ""
        wrong = f"no such field; this data set has {own}, and its identities may have {', '.join(IN_IDENTITY)}"
        needed = f"a field, or a regular expression with one group for the identity{such}"
        raise InputError(where=f"data.split_by: {split_by}", found=wrong, needed=needed)
    search = re.compile(IN_IDENTITY.get(split_by, split_by)).search
    return [found.group(1) if (found := search(identity)) else None for identity in identities]
