"""Episode groups that stay in one split: the episodes of a scene, a day, as `data.split_by` says."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Bool, Int, UInt64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.filters.exclusion import named
from vjepa2_ac.data.index import EpisodeTable, identity_hash
from vjepa2_ac.errors import InputError

# For DROID, whose identities contain .../LAB/success|failure/DATE/..., and for any data in folders.
IN_IDENTITY = {
    "lab": re.compile(r"([^/]+)/(?:success|failure)/"),
    "day": re.compile(r"/(?:success|failure)/([0-9]{4}-[0-9]{2}-[0-9]{2})(?:/|$)"),
    "folder": re.compile(r"^(.+)/[^/]*$"),
}


def split_hash(
    table: EpisodeTable, taking_part: Bool[np.ndarray, " episodes"], config: DataConfig
) -> UInt64[np.ndarray, " episodes"] | None:
    """Return the hash that determines each episode's split: of its group; None: of its identity.

    Args:
        table: The episodes.
        taking_part: Which of them are used; the others need not belong to a group.
        config: `data.split_by`.

    Raises:
        InputError: There is no such field, an episode has none, or a pattern does not match its identity.
    """
    if config.split_by is None:
        return None
    members = np.flatnonzero(taking_part)
    groups = _groups(table, members, config.split_by)
    lacking = [int(member) for member, group in zip(members, groups, strict=True) if not group]
    if lacking:
        raise _without_group(table, lacking, len(members), config.split_by)
    hashes = {group: identity_hash(group) for group in set(groups) if group}
    found = table.id_hash.copy()
    found[members] = [hashes[group] for group in groups if group]
    return found


def _groups(table: EpisodeTable, members: Int[np.ndarray, " members"], split_by: str) -> list[str | None]:
    labels = table.labels.get(split_by)
    if labels is not None:
        return [labels.of_episode(int(member)) for member in members]
    identities = [table.identity(int(member)) for member in members]
    if split_by not in IN_IDENTITY and re.fullmatch(r"[A-Za-z_]+", split_by):
        raise InputError(
            where=f"data.split_by: {split_by}",
            found=f"no such field; this data set has {', '.join(table.labels) or 'none of its own'}, and its identities"
            f" may have {', '.join(IN_IDENTITY)}",
            needed="a field, or a regular expression with one group for the identity"
            + (f", such as {identities[0]}" if identities else ""),
        )
    pattern = IN_IDENTITY.get(split_by) or re.compile(split_by)
    return [found.group(1) if (found := pattern.search(identity)) else None for identity in identities]


def _without_group(table: EpisodeTable, lacking: list[int], members: int, split_by: str) -> InputError:
    from_source = split_by in table.labels
    reason = "the data set does not say it of" if from_source else "found nothing in the identities of"
    names = [table.identity(index) for index in lacking]
    return InputError(
        where=f"data.split_by: {split_by}",
        found=f"{reason} {len(lacking)} of {members} episodes: {named(names)}",
        needed="a group for every episode that takes part",
        fix="Leave these out with data.exclude, or "
        + ("choose another field" if from_source else "choose a pattern that fits every identity"),
    )
