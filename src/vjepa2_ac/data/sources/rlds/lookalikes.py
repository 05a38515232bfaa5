"""Records behind a URL that could be copies of one another: only their states are read while indexing.

The index of a record behind a URL reads no states: for DROID that would be several more reads for each of 95,658
records. A copy under another name differs in its name only: it has the same number of steps, and the same record length
except for the name. Few other records do: records of some 15 MB, nearly all of it images, seldom agree to the byte. A
copy whose images or texts were encoded again has another length, and is not found.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64, UInt64

from vjepa2_ac.config import RldsData
from vjepa2_ac.data.index.episode_table import EpisodeTable
from vjepa2_ac.data.index.state_hash import UNKNOWN, hash_of_states
from vjepa2_ac.data.sources.listing import in_parallel
from vjepa2_ac.data.sources.rlds.example import ExampleRecord
from vjepa2_ac.data.sources.rlds.features import states_of
from vjepa2_ac.data.sources.rlds.index_local import position_of
from vjepa2_ac.data.sources.rlds.shard_reader import RemoteFile, Shard
from vjepa2_ac.errors import InputError

_WINDOW = 1 << 16
_LENGTH_BYTES = 5  # lengths that grow with a name: of text, list, feature, entry of the map, and all of them


def hashes_of_lookalikes(
    table: EpisodeTable, shards: Sequence[Shard], config: RldsData, *, threads: int
) -> UInt64[np.ndarray, " episodes"]:
    """Return the state hash of every record that could be a copy of another; `UNKNOWN` for the others.

    Raises:
        UnreachableError: The network fails.
    """

    def look(index: int) -> int:
        shard, span = position_of(table, shards, index)
        try:
            record = ExampleRecord(RemoteFile(shard, window=_WINDOW), span)
            return hash_of_states(states_of(record, config, int(table.num_steps[index]), str(span)))
        except InputError:
            return UNKNOWN  # reported when the episode is read

    found = np.full(len(table), UNKNOWN, np.uint64)
    chosen = lookalikes(table, tolerance=_LENGTH_BYTES * max(1, len(config.fields.identity)))
    found[chosen] = np.fromiter(in_parallel(look, chosen.tolist(), threads), np.uint64)
    return found


def lookalikes(table: EpisodeTable, *, tolerance: int) -> Int64[np.ndarray, " lookalikes"]:
    """Return the episodes with the same number of steps as another, and the same record length except for the name.

    Args:
        table: With the lengths of the records.
        tolerance: Bytes by which the rest may differ, because encoded lengths of names vary in size.
    """
    rest = table.locators["length"] - np.diff(table.id_ends, prepend=0)
    order = np.lexsort((rest, table.num_steps))
    alike = (np.diff(table.num_steps[order]) == 0) & (np.diff(rest[order]) <= tolerance)
    return np.asarray(order[np.append(alike, False) | np.append(False, alike)], np.int64)
