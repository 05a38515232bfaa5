"""Index of an RLDS data set: its episodes and their positions, found by hopping over almost all of the data.

Of a local record the states are checked, too. Behind a URL a read costs tens of milliseconds: many shards are read at
once, and of a record only as much as gives its name and its steps; its states are checked when the episode is read, and
here only where it may be a copy of another. A copy under another name has the same number of steps, and the same record
length but for the name. Few other records do: of some 15 MB, nearly all of it images, seldom two agree to the byte. A
copy whose images or texts were encoded again has another length, and is not found.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int64

from vjepa2_ac import storage
from vjepa2_ac.config import RldsData
from vjepa2_ac.data.files import in_parallel
from vjepa2_ac.data.index import UNKNOWN, EpisodeProblem, EpisodeTable, hash_of_states
from vjepa2_ac.data.selection import as_problem
from vjepa2_ac.data.sources.indexed_source import Found, Scanned, table_of
from vjepa2_ac.data.sources.rlds.episode import (
    STEP_FLAG,
    Record,
    commands_of,
    identity_of,
    info_of,
    num_steps_of,
    states_of,
    step_features,
)
from vjepa2_ac.data.sources.rlds.shards import Shard, open_shard
from vjepa2_ac.data.sources.rlds.tfrecord import HEADER_BYTES, Read, RecordSpan, require_intact, span_at
from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import zero_steps

FEWEST_IN_FLIGHT = 128  # reads behind a URL: they are small, and sequential within a shard
_SAMPLES = 4
_PLACE = ("shard", "record", "offset", "length")  # columns of the table
_LENGTH_BYTES = 5  # lengths that grow with a name: of text, list, feature, entry of the map, and all of them


def build_index(shards: Sequence[Shard], config: RldsData, cameras: Sequence[str], progress: Progress) -> EpisodeTable:
    """Return every episode of the shards; of its images only the presence is checked, behind a URL in some episodes.

    Args:
        shards: All of the data set's.
        config: Names of the features, and what a state is.
        cameras: Image features that every episode must have.
        progress: Called with the number of scanned episodes.

    Raises:
        InputError: A shard cannot be read, or no episode can be used.
        UnreachableError: The network fails.
    """
    is_far = storage.is_url(config.path)
    threads = max(config.connections, FEWEST_IN_FLIGHT) if is_far else config.connections
    if is_far:
        _require_fitting(shards, config, cameras)

    def scan(number: int) -> list[Found]:
        with open_shard(shards[number]) as read:
            return list(_scan(shards[number], number, read, config, cameras))

    found = (one for of_shard in in_parallel(scan, range(len(shards)), threads) for one in of_shard)
    table = table_of(found, config, sum(shard.episodes for shard in shards), progress)
    return _with_hashes_of_copies(table, shards, config, threads) if is_far else table


def position_of(table: EpisodeTable, shards: Sequence[Shard], index: int) -> tuple[Shard, RecordSpan]:
    """Return the shard and the position of the record of an episode of a table."""
    number, *place = (int(table.locators[name][index]) for name in _PLACE)
    return shards[number], RecordSpan(shards[number].path, *place)


def _scan(shard: Shard, place: int, read: Read, config: RldsData, cameras: Sequence[str]) -> Iterator[Found]:
    """Yield the result of each expected record of a shard; after damage that hides the others, a problem for each."""
    offset = 0
    for number in range(shard.episodes):
        hidden = range(number, shard.episodes)
        if offset == shard.size:
            yield from (_wrong_count(shard, one, f"the file ends after {number} records") for one in hidden)
            return
        try:
            span = span_at(read(offset, HEADER_BYTES), shard.path, number, offset, shard.size)
        except InputError as error:
            yield from (as_problem(error, f"{shard.name}: record {one}") for one in hidden)
            return
        yield _examine(read, span, place, f"{shard.name}: record {number}", config, cameras)
        offset = span.end
    if offset != shard.size:
        yield _wrong_count(shard, shard.episodes, f"{shard.size - offset:,} bytes after the last record")


def _wrong_count(shard: Shard, number: int, found: str) -> EpisodeProblem:
    name, where = f"{shard.name}: record {number}", f"{shard.path}: record {number}"
    needed = f"{shard.episodes} records, says dataset_info.json"
    return EpisodeProblem(name, where, found, needed, "Download the file again")


def _examine(read: Read, span: RecordSpan, shard: int, name: str, config: RldsData, cameras: Sequence[str]) -> Found:
    """Return the episode in a record, or why there is none; it is named like the record if it has no identity."""
    is_far, fields, record = storage.is_url(span.path), config.fields, Record(read, span)
    try:
        if is_far:
            by_states = [{*fields.identity, *fields.state}] if config.states == "pose" else []
            record = Record(read, span, record.locate([{*fields.identity, STEP_FLAG}, *by_states]))
        name = identity_of(record, fields)
        states = None if is_far else _checked_states(record, config, cameras, f"{span} ({name})")
        steps = num_steps_of(record, config) if states is None else len(states)
        if steps == 0:
            raise zero_steps(f"{span} ({name})")
    except InputError as error:
        return as_problem(error if is_far else _damage_or(error, read, span), name)
    place = dict(zip(_PLACE, (shard, span.number, span.offset, span.length), strict=True))
    return Scanned(info_of(name, steps), str(span), place, UNKNOWN if states is None else hash_of_states(states))


def _checked_states(
    record: Record, config: RldsData, cameras: Sequence[str], where: str
) -> Float[np.ndarray, "steps _"]:
    """Return the states of a record that has everything an episode needs.

    Raises:
        InputError: A feature is missing, has no uniform shape over all steps, or has implausible numbers.
    """
    for name in (*config.fields.identity, *step_features(config), *cameras):
        record.place_of(name)
    states = states_of(record, config, num_steps_of(record, config), where)
    commands_of(record, config, len(states), where)
    return states


def _damage_or(error: InputError, read: Read, span: RecordSpan) -> InputError:
    """Return the CRC's error if the record is damaged, which is then the error to show."""
    try:
        require_intact(read, span)
    except InputError as damage:
        return damage
    return error


def _require_fitting(shards: Sequence[Shard], config: RldsData, cameras: Sequence[str]) -> None:
    """Check the first record of some shards as thoroughly as a local one, before all of them are read.

    Raises:
        InputError: None of them can be used: the settings or the data set are wrong.
    """
    errors = []
    for shard in shards[:: max(1, len(shards) // _SAMPLES)]:
        try:
            with open_shard(shard) as read:
                span = span_at(read(0, HEADER_BYTES), shard.path, 0, 0, shard.size)
                _checked_states(Record(read, span), config, cameras, str(span))
                return
        except InputError as error:
            errors.append(error)
    raise errors[0]


def _with_hashes_of_copies(
    table: EpisodeTable, shards: Sequence[Shard], config: RldsData, threads: int
) -> EpisodeTable:
    """Return the table with the state hash of every record that could be a copy of another."""

    def look(index: int) -> int:
        shard, span = position_of(table, shards, index)
        try:
            with open_shard(shard) as read:
                return hash_of_states(states_of(Record(read, span), config, int(table.num_steps[index]), str(span)))
        except InputError:
            return UNKNOWN  # reported when the episode is read

    found = np.full(len(table), UNKNOWN, np.uint64)
    chosen = _possible_copies(table, tolerance=_LENGTH_BYTES * len(config.fields.identity))
    found[chosen] = np.fromiter(in_parallel(look, chosen.tolist(), threads), np.uint64)
    return replace(table, state_hash=found)


def _possible_copies(table: EpisodeTable, tolerance: int) -> Int64[np.ndarray, " copies"]:
    """Return the episodes with as many steps as another, and the same record length but for the name.

    Args:
        table: With the lengths of the records.
        tolerance: Bytes by which the rest may differ, because encoded lengths of names vary in size.
    """
    rest = table.locators["length"] - np.char.str_len(table.ids)
    order = np.lexsort((rest, table.num_steps))
    alike = (np.diff(table.num_steps[order]) == 0) & (np.diff(rest[order]) <= tolerance)
    return np.asarray(order[np.append(alike, False) | np.append(False, alike)], np.int64)
