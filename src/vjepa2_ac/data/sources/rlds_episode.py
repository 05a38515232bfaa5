"""Read an episode from an RLDS record, and index all records by reading their headers and skipping most of the data.

While indexing, the states of local records are also checked. Behind a URL a read takes tens of milliseconds. Therefore
many shards are read concurrently, and only the identity and the number of steps of a record are read; the states are
checked when the episode is read.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from vjepa2_ac import storage
from vjepa2_ac.config import RldsData, RldsFields
from vjepa2_ac.config.sources import RECORD
from vjepa2_ac.data.files import CONNECTIONS, map_in_threads
from vjepa2_ac.data.index import STATES_NOT_READ, EpisodeProblem, EpisodeTable, summarize_states
from vjepa2_ac.data.poses import convert_poses, num_rotation_numbers, require_selection
from vjepa2_ac.data.sources.indexed_source import IndexEntry, ScanResult, build_table, require_indexed_length
from vjepa2_ac.data.sources.rlds_shards import Shard, open_shard
from vjepa2_ac.data.sources.tfrecord import (
    HEADER_BYTES,
    ByteRange,
    Kind,
    NotAnExampleError,
    ReadBytes,
    RecordSpan,
    decode_feature,
    iterate_features,
    parse_header,
    verify_crc,
)
from vjepa2_ac.episode import Episode, EpisodeInfo, FrameReader, Progress
from vjepa2_ac.errors import InputError, counted, did_you_mean
from vjepa2_ac.spaces import no_steps_error, require_finite

IDENTITY_SEPARATOR = "--"  # as in the published lists of DROID's idle ranges
STEP_FLAG = "steps/is_first"
_MAX_BYTES = 1 << 28  # size limit of a feature of numbers or texts, which is read completely
_IN_FLIGHT = 128  # concurrent reads behind a URL, which are small; the reads of a shard are sequential
_SAMPLES = 4  # shards whose first record is checked before a remote data set is indexed
_NUMBERS: tuple[Kind, ...] = ("float_list", "int64_list")  # booleans are stored as integers
_FIX_IDENTITY = "Name text or integer features in data.fields.identity, or set data.fields.identity: record"
_LOCATOR_COLUMNS = ("shard", "record", "offset", "length")  # columns of the table


class Record:
    """The features of one record, read on request.

    Args:
        read: Returns bytes of the file.
        span: The position of the record in the file.
        feature_ranges: The position of each feature, if already known.
    """

    def __init__(self, read: ReadBytes, span: RecordSpan, feature_ranges: dict[str, ByteRange] | None = None) -> None:
        self._read, self._span = read, span
        if feature_ranges is not None:
            self.feature_ranges = feature_ranges

    @property
    def position(self) -> str:
        """The record's file name, which contains split and shard number, and the record's number in the file."""
        return f"{self._span.path.rsplit('/', 1)[-1]}: record {self._span.number}"

    @cached_property
    def feature_ranges(self) -> dict[str, ByteRange]:
        """The position of each feature."""
        return self.locate()

    def locate(self, sufficient: Sequence[set[str]] = ()) -> dict[str, ByteRange]:
        """Return the positions of the features, reading until all features of one of the sets `sufficient` are found.

        Raises:
            InputError: The record is not an Example.
        """
        ranges: dict[str, ByteRange] = {}
        try:
            for name, byte_range in iterate_features(self._read, self._span.data_offset, self._span.length):
                ranges[name] = byte_range
                if any(ranges.keys() >= names for names in sufficient):
                    break
        except NotAnExampleError as error:
            problem = f"not a tf.train.Example ({error})"
            raise InputError(where=str(self._span), found=problem, needed="an RLDS data set") from None
        return ranges

    def find_feature(self, name: str) -> ByteRange:
        """Return the position of a feature.

        Raises:
            InputError: The record lacks the feature. The message lists the existing features.
        """
        if name not in self.feature_ranges:
            names = sorted(self.feature_ranges)
            problem = f"no feature {name}; existing features: {', '.join(names) or 'none'}"
            raise InputError(where=str(self._span), found=problem, fix=f"{did_you_mean(name, names)}Set data.fields")
        return self.feature_ranges[name]

    def read_values(self, name: str, *kinds: Kind) -> Sequence[Any] | np.ndarray:
        """Read the values of a feature.

        Raises:
            InputError: The feature is missing, has another type or is too large, or the file ends within it.
        """
        offset, length = self.find_feature(name)
        where = f"{self._span}: {name}"
        if length > _MAX_BYTES:
            raise InputError(where=where, found=f"{length:,} bytes", needed=f"at most {_MAX_BYTES:,}")
        data = self._read(offset, length)
        if len(data) < length:
            raise InputError(where=where, found=f"{len(data)} bytes at offset {offset}", needed=f"{length} bytes")
        try:
            kind, values = decode_feature(data)
        except NotAnExampleError as error:
            raise InputError(
                where=where, found=f"not a tf.train.Feature ({error})", needed="an RLDS data set"
            ) from None
        if kind is not None and kind not in kinds:
            raise InputError(where=where, found=f"a {kind}", needed=f"a {' or '.join(kinds)}", fix="Check data.fields")
        return values


def read_identity(record: Record, fields: RldsFields) -> str:
    """Return the identity of an episode: the values of some features, or the position of the record.

    Raises:
        InputError: A feature of the identity is missing, empty, or neither text nor integers.
    """
    if fields.identity == RECORD:
        return record.position
    parts: list[str] = []
    for name in fields.identity:
        try:
            values = record.read_values(name, "bytes_list", "int64_list")
        except InputError as error:
            raise InputError(where=error.where, found=error.found, needed=error.needed, fix=_FIX_IDENTITY) from None
        parts += [value.decode(errors="replace") if isinstance(value, bytes) else str(value) for value in values]
    if not any(parts):
        problem = f"the identity is empty ({', '.join(fields.identity)})"
        raise InputError(where=record.position, found=problem, needed="a text or a number", fix=_FIX_IDENTITY)
    return IDENTITY_SEPARATOR.join(parts)


def list_step_features(config: RldsData) -> tuple[str, ...]:
    """Return the names of the features that form the states and the recorded actions."""
    return config.fields.state + (config.fields.action if config.actions == "recorded" else ())


def read_num_steps(record: Record, config: RldsData) -> int:
    """Return the number of steps: the length of the flag `is_first`, or of the states if they are complete poses.

    Raises:
        InputError: The record has neither of these features.
    """
    fields = config.fields
    if config.states == "vector" or fields.select is not None:  # the length of the states is not the number of steps
        record.find_feature(STEP_FLAG)
    if STEP_FLAG in record.feature_ranges:
        return len(record.read_values(STEP_FLAG, "int64_list"))
    count = sum(len(record.read_values(name, *_NUMBERS)) for name in fields.state)
    return count // (4 + num_rotation_numbers(fields.rotation))


def read_episode(record: Record, config: RldsData, info: EpisodeInfo, read_frames: FrameReader, where: str) -> Episode:
    """Read the episode in a record; joint velocities and instruction are optional.

    Args:
        record: The record.
        config: The names of the features and the definition of a state.
        info: The entry of the episode in the index.
        read_frames: Reads the images of the camera.
        where: File, record and identity, for messages.

    Raises:
        InputError: The record does not match the index, lacks a feature, or has implausible numbers.
    """
    require_indexed_length(read_num_steps(record, config), info, where)
    steps, velocity, language = info.num_steps, config.fields.joint_velocity, config.fields.language
    texts = record.read_values(language, "bytes_list") if language in record.feature_ranges else None
    return Episode(
        info=info,
        states=read_states(record, config, steps, where),
        read_frames=read_frames,
        control_rate_hz=config.fields.control_rate_hz,
        joint_velocities=_read_per_step(record, velocity, steps, where) if velocity in record.feature_ranges else None,
        metadata={} if texts is None else {"language": b"".join(texts[:1]).decode(errors="replace")},
        commands=read_commands(record, config, steps, where),
    )


def read_states(record: Record, config: RldsData, steps: int, where: str) -> Float[np.ndarray, "steps state_dim"]:
    """Read the measured states (conventions: `vjepa2_ac.episode`) and check that they are plausible.

    Raises:
        InputError: A feature is missing, does not have the same count of numbers at each step, or has
            implausible states.
    """
    if steps == 0:
        raise no_steps_error(where)
    fields = config.fields
    columns = [_read_per_step(record, name, steps, where) for name in fields.state]
    widths = {name: column.shape[1] for name, column in zip(fields.state, columns, strict=True)}
    described = {f"{name} [{width}]": width for name, width in widths.items()}
    require_selection(described, fields, "data.fields", is_pose=config.states == "pose", episode=where)
    numbers = np.concatenate(columns, axis=1)
    if fields.select is not None:
        numbers = numbers[:, list(fields.select)]
    if config.states == "vector":
        require_finite(numbers, where, fix="Check data.fields.state, or exclude the episode")
        return numbers
    return convert_poses(numbers, fields, where, section="data.fields")


def read_commands(
    record: Record, config: RldsData, steps: int, where: str
) -> Float[np.ndarray, "steps action_dim"] | None:
    """Read the recorded actions if `data.actions` is recorded, otherwise return None.

    Raises:
        InputError: A feature is missing, does not have the same count of numbers at each step, or has
            numbers that are not finite.
    """
    if config.actions != "recorded":
        return None
    commands = np.concatenate([_read_per_step(record, name, steps, where) for name in config.fields.action], axis=1)
    require_finite(commands, f"{where}: {', '.join(config.fields.action)}", fix="Check data.fields.action")
    return commands


def _read_per_step(record: Record, name: str, steps: int, where: str) -> Float[np.ndarray, "steps width"]:
    values = np.asarray(record.read_values(name, *_NUMBERS), np.float64)
    if len(values) == 0 or len(values) % steps:
        problem, needed = f"{len(values)} numbers", f"the same count for each of {counted(steps, 'step')}"
        raise InputError(where=f"{where}: {name}", found=problem, needed=needed)
    return values.reshape(steps, -1)


# ---- the index of all episodes ----


def build_index(shards: Sequence[Shard], config: RldsData, cameras: Sequence[str], progress: Progress) -> EpisodeTable:
    """Index all episodes of the shards.

    Only the presence of images is checked, and behind a URL only in some episodes.

    Args:
        shards: All shards of the data set.
        config: The names of the features and the definition of a state.
        cameras: Image features that every episode must have.
        progress: Called with (done, total) after each episode.

    Raises:
        InputError: A shard cannot be read, or no episode can be used.
        UnreachableError: The network fails.
    """
    is_remote = storage.is_url(config.path)
    threads = _IN_FLIGHT if is_remote else CONNECTIONS
    if is_remote:
        _require_usable_sample(shards, config, cameras)

    def scan(number: int) -> list[ScanResult]:
        with open_shard(shards[number]) as read:
            return list(_scan_shard(shards[number], number, read, config, cameras))

    results = itertools.chain.from_iterable(map_in_threads(scan, range(len(shards)), threads))
    return build_table(results, config, sum(shard.episodes for shard in shards), progress)


def locate_record(table: EpisodeTable, shards: Sequence[Shard], index: int) -> tuple[Shard, RecordSpan]:
    """Return the shard and the position of an episode's record."""
    number, *span = (int(table.locators[name][index]) for name in _LOCATOR_COLUMNS)
    return shards[number], RecordSpan(shards[number].path, *span)


def _scan_shard(
    shard: Shard, shard_index: int, read: ReadBytes, config: RldsData, cameras: Sequence[str]
) -> Iterator[ScanResult]:
    """Yield the result of each expected record of a shard; all records after a damaged length are problems."""
    offset = 0
    for number in range(shard.episodes):
        remaining = range(number, shard.episodes)
        if offset == shard.size:
            yield from (
                _make_count_problem(shard, record, f"the file ends after {number} records") for record in remaining
            )
            return
        try:
            span = parse_header(read(offset, HEADER_BYTES), shard.path, number, offset, shard.size)
        except InputError as error:
            yield from (EpisodeProblem.from_error(error, f"{shard.name}: record {record}") for record in remaining)
            return
        yield _scan_record(read, span, shard_index, f"{shard.name}: record {number}", config, cameras)
        offset = span.end
    if offset != shard.size:
        yield _make_count_problem(shard, shard.episodes, f"{shard.size - offset:,} bytes after the last record")


def _make_count_problem(shard: Shard, number: int, problem: str) -> EpisodeProblem:
    name, where = f"{shard.name}: record {number}", f"{shard.path}: record {number}"
    needed = f"{shard.episodes} records, according to dataset_info.json"
    return EpisodeProblem(name, where, problem, needed, "Download the file again")


def _scan_record(
    read: ReadBytes, span: RecordSpan, shard: int, name: str, config: RldsData, cameras: Sequence[str]
) -> ScanResult:
    """Return the index entry or the problem of a record; `name` is used for records without a readable identity."""
    is_remote, fields, record = storage.is_url(span.path), config.fields, Record(read, span)
    try:
        if is_remote:
            sufficient = [{*fields.identity_features, STEP_FLAG}]
            if config.states == "pose":
                sufficient.append({*fields.identity_features, *fields.state})
            record = Record(read, span, record.locate(sufficient))
        name = read_identity(record, fields)
        states = None if is_remote else _read_checked_states(record, config, cameras, f"{span} ({name})")
        steps = read_num_steps(record, config) if states is None else len(states)
        if steps == 0:
            raise no_steps_error(f"{span} ({name})")
    except InputError as error:
        return EpisodeProblem.from_error(error if is_remote else _prefer_crc_error(error, read, span), name)
    locator = dict(zip(_LOCATOR_COLUMNS, (shard, span.number, span.offset, span.length), strict=True))
    # Only the identities of DROID contain the outcome.
    success = True if "/success/" in name else False if "/failure/" in name else None
    info = EpisodeInfo(id=name, num_steps=steps, success=success)
    return IndexEntry(info, str(span), locator, STATES_NOT_READ if states is None else summarize_states(states))


def _read_checked_states(
    record: Record, config: RldsData, cameras: Sequence[str], where: str
) -> Float[np.ndarray, "steps _"]:
    """Return the states of a record after checking that it has all features of an episode.

    Raises:
        InputError: A feature is missing, does not have the same count of numbers at each step, or has
            implausible numbers.
    """
    for name in (*config.fields.identity_features, *list_step_features(config), *cameras):
        record.find_feature(name)
    states = read_states(record, config, read_num_steps(record, config), where)
    read_commands(record, config, len(states), where)
    return states


def _prefer_crc_error(error: InputError, read: ReadBytes, span: RecordSpan) -> InputError:
    """Return an error about the CRC if the record is damaged, otherwise the original error."""
    try:
        verify_crc(read, span)
    except InputError as damage:
        return damage
    return error


def _require_usable_sample(shards: Sequence[Shard], config: RldsData, cameras: Sequence[str]) -> None:
    """Check the first record of some remote shards as thoroughly as a local one, before all shards are read.

    Raises:
        InputError: None of these records can be used, so the settings or the data set are wrong.
    """
    errors = []
    for shard in shards[:: max(1, len(shards) // _SAMPLES)]:
        try:
            with open_shard(shard) as read:
                span = parse_header(read(0, HEADER_BYTES), shard.path, 0, 0, shard.size)
                _read_checked_states(Record(read, span), config, cameras, str(span))
                return
        except InputError as error:
            errors.append(error)
    raise errors[0]
