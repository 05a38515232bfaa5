"""How does a run go on without an episode that cannot be used? By its identity, in `data.exclude`."""

from __future__ import annotations

import json
from collections.abc import Sequence

from vjepa2_ac.config import DataConfig
from vjepa2_ac.episode import EpisodeInfo
from vjepa2_ac.errors import InputError

NAMED = 10  # episodes in one message, at most


def included(infos: Sequence[EpisodeInfo], config: DataConfig) -> list[int]:
    """Return which episodes take part: all but those that `data.exclude` names.

    Raises:
        InputError: `data.exclude` names what no episode is called.
    """
    excluded = frozenset(config.exclude)
    if unknown := sorted(excluded.difference(info.id for info in infos)):
        raise InputError(
            where="data.exclude",
            found=f"not the identity of any episode: {named(unknown)}",
            needed="identities as errors name them" + (f", such as {infos[0].id}" if infos else ""),
        )
    return [number for number, info in enumerate(infos) if info.id not in excluded]


def with_way_out(error: InputError, ids: Sequence[str]) -> InputError:
    """Return an error of one or more episodes that says, too, how to leave them out."""
    others = f"{len(ids) - 1} more cannot be used either. " if len(ids) > 1 else ""
    fix = f"{error.fix.rstrip('.')}. " if error.fix else ""
    return InputError(
        where=error.where,
        found=error.found,
        needed=error.needed,
        fix=f"{others}{fix}To leave out, add to data.exclude: {json.dumps(list(ids), ensure_ascii=False)}",
    )


def named(ids: Sequence[str]) -> str:
    """Return identities as a message shows them: the first ten, and how many more there are."""
    return ", ".join(ids[:NAMED]) + (f" and {len(ids) - NAMED} more" if len(ids) > NAMED else "")
