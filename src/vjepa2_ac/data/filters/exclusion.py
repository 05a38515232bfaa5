"""Exclusion of single episodes from a run, by their identity in `data.exclude`."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.index import EpisodeTable, identity_hash
from vjepa2_ac.errors import InputError

NAMED = 10  # episodes in one message, at most


def included(table: EpisodeTable, config: DataConfig) -> Bool[np.ndarray, " episodes"]:
    """Return which episodes are used: all except those in `data.exclude`.

    Raises:
        InputError: `data.exclude` contains an unknown identity.
    """
    excluded = frozenset(config.exclude)
    hashes = np.array([identity_hash(name) for name in excluded], np.uint64)
    candidates = np.flatnonzero(np.isin(table.id_hash, hashes))
    found = {int(index): table.identity(int(index)) for index in candidates}
    known = frozenset(found.values()).union(problem.name for problem in table.problems)
    if unknown := sorted(excluded - known):
        raise InputError(
            where="data.exclude",
            found=f"not the identity of any episode: {named(unknown)}",
            needed="identities as errors name them" + (f", such as {table.identity(0)}" if len(table) else ""),
        )
    taking_part = np.ones(len(table), bool)
    taking_part[[index for index, name in found.items() if name in excluded]] = False
    return taking_part


def with_way_out(error: InputError, names: Sequence[str], *, skippable: bool = True) -> InputError:
    """Return an error of one or more episodes with the way to exclude them: ten of them, and the number of the rest.

    Args:
        error: What is wrong with the first of them.
        names: Their identities.
        skippable: Whether `data.broken_episodes: skip` would skip them.
    """
    others = f"{len(names) - 1} more cannot be used either. " if len(names) > 1 else ""
    fix = f"{error.fix.rstrip('.')}. " if error.fix else ""
    listed = json.dumps(list(names[:NAMED]), ensure_ascii=False)
    of_all = f" (the first {NAMED} of {len(names)})" if len(names) > NAMED else ""
    skip = "set data.broken_episodes: skip, or " if skippable else ""
    return InputError(
        where=error.where,
        found=error.found,
        needed=error.needed,
        fix=f"{others}{fix}To go on without, {skip}add{of_all} to data.exclude: {listed}",
    )


def named(ids: Sequence[str], count: int | None = None) -> str:
    """Return identities for a message: the first ten, and the number of the rest (of `count` in total)."""
    more = (len(ids) if count is None else count) - NAMED
    return ", ".join(ids[:NAMED]) + (f" and {more} more" if more > 0 else "")
