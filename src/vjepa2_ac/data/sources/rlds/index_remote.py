"""Index of an RLDS data set behind a URL, built with a few small reads per episode.

A read costs tens of milliseconds, so many shards are read at once, and only as much of a record is read as gives its
name and its steps: its states are checked when the episode is read, and here only where it may be a copy
(`lookalikes`). TFDS writes the features of a record in the order of a hash, which differs between processes: its names
are before, between or after the images. Read are its head; its end, which comes with the head of the next record; then
what is between the images. That is one read per record where the names come first, three on average over all orders.
The size of a read is decided by a few records.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from vjepa2_ac.config import RldsData, RldsFields
from vjepa2_ac.data.index.episode_table import EpisodeTable
from vjepa2_ac.data.selection import as_problem
from vjepa2_ac.data.sources.listing import in_parallel
from vjepa2_ac.data.sources.rlds.example import ExampleRecord, not_an_example
from vjepa2_ac.data.sources.rlds.features import STEP_FLAG, check_record, identity_of, info_of, num_steps_of
from vjepa2_ac.data.sources.rlds.index_local import Found, ScannedEpisode, scan_shard, table_of
from vjepa2_ac.data.sources.rlds.lookalikes import hashes_of_lookalikes
from vjepa2_ac.data.sources.rlds.shard_reader import RemoteFile, Shard
from vjepa2_ac.data.sources.rlds.tfrecord import HEADER_BYTES, RecordSpan, span_at
from vjepa2_ac.data.sources.rlds.wire_format import Located, NotAnExampleError, Read, features_behind, iterate_features
from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import zero_steps

logger = logging.getLogger(__name__)

FEWEST_IN_FLIGHT = 128  # reads of an index are small and sequential within a shard

_SAMPLES = 16
_PIECES = 8  # buffered reads of a record: its end contains the head of the next
_NAME_BYTES = 160  # more than the size of a feature's name and headers
_SAMPLE_WINDOW = 1 << 16
_WINDOWS = tuple(1 << power for power in range(10, 16))
_ASSUMED_LATENCY_S, _ASSUMED_REQUEST_S, _ASSUMED_BYTES_PER_S = 0.04, 5e-4, 1e8  # a request: Python's own time
_FLAGS = (STEP_FLAG, "steps/is_last", "steps/is_terminal")  # always one byte per step


@dataclass(frozen=True)
class RecordLayout:
    """Facts about all records from a few complete ones: bytes per step of each feature, and the size of a read."""

    step_bytes: dict[str, int]
    window: int

    def steps_in(self, name: str, length: int) -> int | None:
        """Return the number of steps implied by a feature's length, or None."""
        payload = _payload(_payload(length))
        width = self.step_bytes.get(name)
        if width is None or payload is None or payload % width:
            return None
        return payload // width


def index_remote(
    shards: Sequence[Shard], config: RldsData, cameras: Sequence[str], *, threads: int, progress: Progress
) -> EpisodeTable:
    """Return every episode of shards behind a URL, by identity and number of steps.

    Args:
        shards: All of the data set's.
        config: Names of the features, and what a state is.
        cameras: Image features that episodes must have; checked in a few of them.
        threads: Shards that are read at once, at least `FEWEST_IN_FLIGHT`.
        progress: Called with the number of episodes found.

    Raises:
        InputError: No episode can be used; a shard cannot be read.
    """
    layout = learn_layout(shards, config, cameras)

    def examine(read: Read, span: RecordSpan, name: str) -> Found:
        try:
            found, steps = _search(read, span, config.fields, layout)
            record = ExampleRecord(read, span, found)
            name = identity_of(record, config.fields)
            steps = num_steps_of(record, config) if steps is None else steps
            if steps == 0:
                raise zero_steps(f"{span} ({name})")
        except InputError as error:
            return as_problem(error, name)
        return ScannedEpisode(info_of(name, steps), span)

    def scan(shard: Shard) -> list[Found]:
        return list(scan_shard(RemoteFile(shard, window=layout.window, buffered=_PIECES), shard, examine))

    threads = max(threads, FEWEST_IN_FLIGHT)
    table = table_of(shards, in_parallel(scan, shards, threads), progress)
    return replace(table, state_hash=hashes_of_lookalikes(table, shards, config, threads=threads))


def learn_layout(shards: Sequence[Shard], config: RldsData, cameras: Sequence[str]) -> RecordLayout:
    """Check the first record of a few shards as thoroughly as a local one.

    Raises:
        InputError: None of them can be used: the settings or the data set are wrong.
    """

    def first_record(shard: Shard) -> tuple[ExampleRecord, int] | InputError:
        try:
            read = RemoteFile(shard, window=_SAMPLE_WINDOW)
            span = span_at(read(0, HEADER_BYTES), shard.path, 0, 0, shard.size)
            record = ExampleRecord(read, span)
            return record, check_record(record, config, cameras, str(span))[0]
        except InputError as error:
            return error

    chosen = [shards[number * len(shards) // _SAMPLES] for number in range(_SAMPLES)]
    looked = list(in_parallel(first_record, list(dict.fromkeys(chosen)), _SAMPLES))
    good = [one for one in looked if not isinstance(one, InputError)]
    if not good:
        raise next(one for one in looked if isinstance(one, InputError))
    step_bytes = _step_bytes(good, config.fields)

    def cost_s(window: int) -> float:
        return sum(_cost_s(record, config.fields, step_bytes.keys(), window) for record, _ in good)

    window = min(_WINDOWS, key=cost_s)
    logger.info("the index is made with reads of %d KB", window >> 10)
    return RecordLayout(step_bytes, window)


def _step_bytes(records: Iterable[tuple[ExampleRecord, int]], fields: RldsFields) -> dict[str, int]:
    """Return the bytes per step of every feature with a constant number per step in all of the records."""
    found: dict[str, set[float]] = {}
    for record, steps in records:
        for name, place in record.located.items():
            if name in fields.state or (name.startswith("steps/") and record.is_float(name)) or name in _FLAGS:
                found.setdefault(name, set()).add((_payload(_payload(place.length)) or 0) / steps)
    widths = {name: next(iter(of_all)) for name, of_all in found.items() if len(of_all) == 1}
    return {name: int(width) for name, width in widths.items() if width >= 1 and width == int(width)}


def _cost_s(record: ExampleRecord, fields: RldsFields, telling: Iterable[str], window: int) -> float:
    """Return the time in seconds to find identity and steps with reads of a window: latency plus transfer."""
    reads = 0
    places, wanted = record.located, frozenset(fields.identity)
    first, last = min(place.offset for place in places.values()), max(sum(place) for place in places.values())
    pieces: list[tuple[int, int]] = [(first, first + window)]

    def is_read(start: int, end: int) -> bool:
        return any(piece[0] <= start and end <= piece[1] for piece in pieces)

    missing, steps_known, before = set(wanted), False, first
    for name, place in places.items():
        end = sum(place) if name in missing else place.offset
        if not is_read(place.offset, end) and reads == 0:
            pieces.append((last - window, last))  # together with the head of the next record
            reads = 1
            missing -= {one for one in missing if is_read(places[one].offset, sum(places[one]))}
            if not missing and steps_known:
                break
        if not is_read(place.offset, end):
            reads += 1
            pieces.append((before, before + window))
        missing.discard(name)
        steps_known = steps_known or name in telling
        before = sum(place)
        if steps_known and not missing:
            break
    read_bytes = window * (1 + reads)
    shared_s = max(1, reads) * _ASSUMED_REQUEST_S + read_bytes / _ASSUMED_BYTES_PER_S
    return max(1, reads) * _ASSUMED_LATENCY_S + FEWEST_IN_FLIGHT * shared_s


def _search(
    read: Read, span: RecordSpan, fields: RldsFields, layout: RecordLayout
) -> tuple[dict[str, Located], int | None]:
    """Return features, including the identity's, and the number of steps; of a record without them, all features."""
    found: dict[str, Located] = {}
    steps: int | None = None
    end = span.data_offset + span.length
    head_end, tail_start = span.offset + layout.window, max(span.data_offset, end - layout.window)
    looked_at_end = False
    try:
        for feature, place in iterate_features(read, span.data_offset, span.length):
            found[feature] = place
            steps = layout.steps_in(feature, place.length) if steps is None else steps
            if not looked_at_end and not found.keys() >= set(fields.identity) and sum(place) + _NAME_BYTES > head_end:
                looked_at_end = True
                tail = read(tail_start, end + layout.window - tail_start)[: end - tail_start]
                for name in fields.identity:
                    found |= features_behind(name, tail, tail_start) if name not in found else {}
            if steps is not None and found.keys() >= set(fields.identity):
                break
    except NotAnExampleError as error:
        raise not_an_example(span, error) from None
    return found, steps


def _payload(length: int | None) -> int | None:
    """Return the content size of a length-delimited field of `length` bytes including its tag and length."""
    if length is None:
        return None
    for header in range(2, 7):
        content = length - header
        if content >= 0 and 1 + max(1, -(-content.bit_length() // 7)) == header:
            return content
    return None
