"""Index of a local RLDS data set: its episodes and their positions, found by skipping over almost all of the data."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vjepa2_ac.config import RldsData
from vjepa2_ac.data.index.episode_table import EpisodeProblem, EpisodeTable
from vjepa2_ac.data.index.state_hash import UNKNOWN, hash_of_states
from vjepa2_ac.data.selection import as_error, as_problem
from vjepa2_ac.data.sources.listing import in_parallel
from vjepa2_ac.data.sources.rlds.example import ExampleRecord
from vjepa2_ac.data.sources.rlds.features import check_record, identity_of, info_of
from vjepa2_ac.data.sources.rlds.shard_reader import Shard, open_shard
from vjepa2_ac.data.sources.rlds.tfrecord import HEADER_BYTES, RecordSpan, require_intact, span_at
from vjepa2_ac.data.sources.rlds.wire_format import Read
from vjepa2_ac.episode import EpisodeInfo, Progress
from vjepa2_ac.errors import InputError

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ScannedEpisode:
    """A usable episode, and its record."""

    info: EpisodeInfo
    span: RecordSpan
    state_hash: int = UNKNOWN


Found = ScannedEpisode | EpisodeProblem
Examine = Callable[[Read, RecordSpan, str], Found]  # of a record, and its name if it has no identity


def index_local(
    shards: Sequence[Shard], config: RldsData, cameras: Sequence[str], *, threads: int, progress: Progress
) -> EpisodeTable:
    """Return every episode of local shards; its states are checked, of its images only the presence.

    Args:
        shards: All of the data set's.
        config: Names of the features, and what a state is.
        cameras: Image features that every episode must have.
        threads: Shards that are read at once.
        progress: Called with the number of scanned episodes.

    Raises:
        InputError: A shard cannot be read, or no episode can be used.
    """

    def examine(read: Read, span: RecordSpan, name: str) -> Found:
        record = ExampleRecord(read, span)
        try:
            name = identity_of(record, config.fields)
            steps, states = check_record(record, config, cameras, f"{span} ({name})")
        except InputError as error:
            return as_problem(_damage_or(error, read, span), name)
        return ScannedEpisode(info_of(name, steps), span, hash_of_states(states))

    def scan(shard: Shard) -> list[Found]:
        with open_shard(shard) as read:
            return list(scan_shard(read, shard, examine))

    return table_of(shards, in_parallel(scan, shards, threads), progress)


def scan_shard(read: Read, shard: Shard, examine: Examine) -> Iterator[Found]:
    """Yield the result of each expected record of a shard; after damage that hides the others, a problem for each."""
    offset = 0
    for number in range(shard.episodes):
        if offset == shard.size:
            yield from _missing(shard, number, f"the file ends after {number} records")
            return
        name = f"{shard.name}: record {number}"
        try:
            span = span_at(read(offset, HEADER_BYTES), shard.path, number, offset, shard.size)
        except InputError as error:
            yield as_problem(error, name)
            yield from _missing(shard, number + 1, f"cannot be found behind the damage at byte {offset}")
            return
        yield examine(read, span, name)
        offset = span.end
    if offset != shard.size:
        yield _other_count(shard, shard.episodes, f"{shard.size - offset:,} bytes after the last record")


def _missing(shard: Shard, first: int, found: str) -> Iterator[EpisodeProblem]:
    return (_other_count(shard, number, found) for number in range(first, shard.episodes))


def _other_count(shard: Shard, number: int, found: str) -> EpisodeProblem:
    name, where = f"{shard.name}: record {number}", f"{shard.path}: record {number}"
    needed = f"{shard.episodes} records, says dataset_info.json"
    return EpisodeProblem(name, where, found, needed, "Download the file again")


def table_of(shards: Sequence[Shard], found: Iterator[list[Found]], progress: Progress) -> EpisodeTable:
    """Return the table of the results, shard by shard; of episodes with one identity the first stays.

    Args:
        shards: All of the data set's.
        found: The results of each.
        progress: Called with the number of scanned episodes.

    Raises:
        InputError: No episode can be used: the first one's error.
    """
    usable: dict[str, ScannedEpisode] = {}
    problems: list[EpisodeProblem] = []
    numbers: list[int] = []
    done, total = 0, sum(shard.episodes for shard in shards)
    for number, (shard, of_shard) in enumerate(zip(shards, found, strict=True)):
        for one in of_shard:
            if isinstance(one, EpisodeProblem):
                problems.append(one)
            elif one.info.id in usable:
                problems.append(_same_identity(one, usable[one.info.id].span))
            else:
                usable[one.info.id] = one
                numbers.append(number)
        done += shard.episodes
        progress(done, total)
    if not usable:
        raise as_error(problems[0])
    logger.info("%d episodes in %d shards; %d cannot be used", len(usable), len(shards), len(problems))
    rows = list(usable.values())
    return EpisodeTable.of(
        [row.info for row in rows],
        problems=problems,
        locators={
            "shard": np.array(numbers, np.int32),
            "record": np.array([row.span.number for row in rows], np.int32),
            "offset": np.array([row.span.offset for row in rows], np.int64),
            "length": np.array([row.span.length for row in rows], np.int64),
        },
        state_hashes=[row.state_hash for row in rows],
    )


def position_of(table: EpisodeTable, shards: Sequence[Shard], index: int) -> tuple[Shard, RecordSpan]:
    """Return the shard and the position of the record of an episode of a table."""
    at = {name: int(column[index]) for name, column in table.locators.items()}
    shard = shards[at["shard"]]
    return shard, RecordSpan(shard.path, at["record"], at["offset"], at["length"])


def _damage_or(error: InputError, read: Read, span: RecordSpan) -> InputError:
    """Return the CRC's error if the record is damaged, which is then the error to show."""
    try:
        require_intact(read, span)
    except InputError as damage:
        return damage
    return error


def _same_identity(row: ScannedEpisode, first: RecordSpan) -> EpisodeProblem:
    return EpisodeProblem(
        name=row.info.id,
        where=str(row.span),
        found=f"the same identity as {first}: {row.info.id}",
        needed="episodes that can be told apart: the split is a hash of the identity",
        fix="Add a feature to data.fields.identity that differs between them",
    )
