"""Index of a local RLDS data set: its episodes and their positions, found by skipping over almost all of the data."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from vjepa2_ac.config import RldsData
from vjepa2_ac.data.filters.broken_episodes import as_error, as_problem
from vjepa2_ac.data.index.episode_table import EpisodeProblem, EpisodeTable
from vjepa2_ac.data.index.state_hash import UNKNOWN, hash_of_states
from vjepa2_ac.data.sources.rlds.dataset_info import Shard
from vjepa2_ac.data.sources.rlds.example import ExampleRecord
from vjepa2_ac.data.sources.rlds.features import (
    commands_of,
    features_of_steps,
    identity_of,
    info_of,
    num_steps_of,
    states_of,
)
from vjepa2_ac.data.sources.rlds.shard_reader import open_shard
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
Examine = Callable[[Read, RecordSpan], Found]


def index_local(
    shards: Sequence[Shard], config: RldsData, cameras: Sequence[str], *, threads: int, progress: Progress | None
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

    def examine(read: Read, span: RecordSpan) -> Found:
        return _examine(read, span, config, cameras)

    def scan(shard: Shard) -> list[Found]:
        with open_shard(shard) as read:
            return list(scan_shard(read, shard, examine))

    return table_of(shards, in_parallel(scan, shards, threads, progress))


def scan_shard(read: Read, shard: Shard, examine: Examine) -> Iterator[Found]:
    """Yield the result of each expected record of a shard; after damage that hides the others, a problem for each."""
    offset = 0
    for number in range(shard.episodes):
        if offset == shard.size:
            yield from _missing(shard, number, f"the file ends after {number} records")
            return
        try:
            span = span_at(read(offset, HEADER_BYTES), shard.path, number, offset, shard.size)
        except InputError as error:
            yield as_problem(error, _place(shard, number))
            yield from _missing(shard, number + 1, f"cannot be found behind the damage at byte {offset}")
            return
        yield examine(read, span)
        offset = span.end
    if offset != shard.size:
        yield _promise_broken(shard, shard.episodes, f"{shard.size - offset:,} bytes after the last record")


def _missing(shard: Shard, first: int, found: str) -> Iterator[EpisodeProblem]:
    return (_promise_broken(shard, number, found) for number in range(first, shard.episodes))


def _promise_broken(shard: Shard, number: int, found: str) -> EpisodeProblem:
    return EpisodeProblem(
        name=_place(shard, number),
        where=f"{shard.path}: record {number}",
        found=found,
        needed=f"{shard.episodes} records, says dataset_info.json",
        fix="Download the file again",
    )


def in_parallel(
    scan: Callable[[Shard], list[Found]], shards: Sequence[Shard], threads: int, progress: Progress | None
) -> Iterator[list[Found]]:
    """Yield the results of each shard, in order, with several read at once."""
    total = sum(shard.episodes for shard in shards)
    done = 0
    pool = ThreadPoolExecutor(min(threads, len(shards)))
    try:
        for shard, found in zip(shards, pool.map(scan, shards), strict=True):
            yield found
            done += shard.episodes
            if progress is not None:
                progress(done, total)
    finally:
        pool.shutdown(cancel_futures=True)


def table_of(shards: Sequence[Shard], found: Iterator[list[Found]]) -> EpisodeTable:
    """Return the table of the results, shard by shard; of episodes with one identity the first stays.

    Raises:
        InputError: No episode can be used: the first one's error.
    """
    rows: list[ScannedEpisode] = []
    problems: list[EpisodeProblem] = []
    numbers: list[int] = []
    first: dict[str, RecordSpan] = {}
    for number, of_shard in enumerate(found):
        for one in of_shard:
            if isinstance(one, ScannedEpisode) and one.info.id in first:
                one = _same_identity(one, first[one.info.id])
            if isinstance(one, EpisodeProblem):
                problems.append(one)
                continue
            first[one.info.id] = one.span
            rows.append(one)
            numbers.append(number)
    if not rows:
        raise as_error(problems[0])
    spans = [row.span for row in rows]
    logger.info("%d episodes in %d shards; %d cannot be used", len(rows), len(shards), len(problems))
    return EpisodeTable.of(
        [row.info for row in rows],
        problems=problems,
        locators={
            "shard": np.array(numbers, np.int32),
            "record": np.array([span.number for span in spans], np.int32),
            "offset": np.array([span.offset for span in spans], np.int64),
            "length": np.array([span.length for span in spans], np.int64),
        },
        state_hashes=[row.state_hash for row in rows],
    )


def place_of(span: RecordSpan) -> str:
    """Return a name for an episode whose identity cannot be read."""
    return f"{span.path.replace(chr(92), '/').rsplit('/', 1)[-1]}: record {span.number}"


def _examine(read: Read, span: RecordSpan, config: RldsData, cameras: Sequence[str]) -> Found:
    """Check identity, steps, states and the presence of the images."""
    name = place_of(span)
    record = ExampleRecord(read, span)
    try:
        name = identity_of(record, config.fields)
        record.require([*features_of_steps(config), *cameras])
        steps = num_steps_of(record, config)
        states = states_of(record, config, steps, f"{span} ({name})")
        commands_of(record, config, steps, f"{span} ({name})")
    except InputError as error:
        return as_problem(_damage_or(error, read, span), name)
    return ScannedEpisode(info_of(name, steps), span, hash_of_states(states))


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


def _place(shard: Shard, number: int) -> str:
    return f"{shard.name}: record {number}"
