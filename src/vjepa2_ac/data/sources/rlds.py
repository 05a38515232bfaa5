"""How do RLDS episodes become `Episode`s? One tf.train.Example each, read without TensorFlow, pictures on demand."""

from __future__ import annotations

import io
import itertools
import logging
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig, RldsFields
from vjepa2_ac.data.exclusion import NAMED, with_way_out
from vjepa2_ac.data.sources.dataset_info import find_shards, index_shards
from vjepa2_ac.data.sources.jpeg import JpegReader
from vjepa2_ac.data.sources.record import Record
from vjepa2_ac.data.sources.states import require_plausible
from vjepa2_ac.data.sources.tfrecord import RecordSpan, read_record
from vjepa2_ac.episode import STATE_DIM, Episode, EpisodeInfo
from vjepa2_ac.errors import InputError

logger = logging.getLogger(__name__)

IDENTITY_SEPARATOR = "--"  # as in the published lists of DROID's idle ranges

_STEP_FLAG = "steps/is_first"
_CACHED_EPISODES = 4


class RldsSource:
    """The episodes of an RLDS data set, in the order of its shards.

    Nothing is read before the first call. `infos` reads a few kilobytes of each episode and checks its states; `read`
    reads the whole record and checks its CRC, and its pictures are decoded when asked for. The last few episodes are
    kept per process. Of episodes in `data.exclude` nothing but the identity is read; their length is given as 0.
    """

    def __init__(self, config: DataConfig) -> None:
        self._config = config
        self._kept: OrderedDict[int, Episode] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """Travel to a loader worker with the index, without the kept episodes."""
        return self.__dict__ | {"_kept": OrderedDict()}

    def infos(self) -> Sequence[EpisodeInfo]:
        """Return identity, length and outcome of every episode.

        Raises:
            InputError: No data set, a damaged one, a missing field, what cannot be a robot's states, or two episodes
                of the same identity.
        """
        return self._infos

    def read(self, index: int) -> Episode:
        """Return one episode.

        Raises:
            InputError: The record is damaged, lacks a field, or holds what cannot be a robot's state.
        """
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        episode = self._read(self._spans[index])
        self._kept[index] = episode
        if len(self._kept) > _CACHED_EPISODES:
            self._kept.popitem(last=False)
        return episode

    @cached_property
    def _spans(self) -> list[RecordSpan]:
        return index_shards(find_shards(self._config.path))

    @cached_property
    def _infos(self) -> list[EpisodeInfo]:
        infos: list[EpisodeInfo] = []
        unusable: dict[str, InputError] = {}
        for info, error in self._scan():
            infos.append(info)
            if error is not None:
                unusable[info.id] = error
            if len(unusable) == NAMED:
                break
        if unusable:
            first = next(iter(unusable.values()))
            settings_at_fault = len(unusable) == len(infos) > 1
            raise first if settings_at_fault else with_way_out(first, list(unusable))
        self._require_distinct(infos)
        logger.info("%s: %d episodes, %d steps", self._config.path, len(infos), sum(info.num_steps for info in infos))
        return infos

    def _scan(self) -> Iterator[tuple[EpisodeInfo, InputError | None]]:
        """Yield what is known of every episode, and why it cannot be used, if so.

        Raises:
            InputError: An episode cannot even be named.
        """
        for path, spans in itertools.groupby(self._spans, key=lambda span: span.path):
            with closing(storage.open_to_read(path)) as file:
                for span in spans:
                    yield self._scan_episode(Record(file, span, span.data_offset), span)

    def _scan_episode(self, record: Record, span: RecordSpan) -> tuple[EpisodeInfo, InputError | None]:
        fields = self._config.fields
        try:
            info = EpisodeInfo(id=_identity_of(record, fields), num_steps=0)
        except InputError as error:
            raise _damage_or(error, span) from None
        if info.id in self._config.exclude:
            return info, None
        try:
            record.require([*fields.state, fields.cameras[self._config.camera]])
            info = _info_of(record, fields)
            _states_of(record, fields, info.num_steps, f"{span} ({info.id})")
        except InputError as error:
            return info, _damage_or(error, span)
        return info, None

    def _read(self, span: RecordSpan) -> Episode:
        data = read_record(span, check_crc=self._config.check_crc)
        record = Record(io.BytesIO(data), span, 0)
        fields = self._config.fields
        info = _info_of(record, fields)
        where = f"{span} ({info.id})"
        pictures = record.values(fields.cameras[self._config.camera], "bytes_list")
        if len(pictures) != info.num_steps:
            raise InputError(
                where=f"{where}: {fields.cameras[self._config.camera]}",
                found=f"{len(pictures)} pictures",
                needed=f"one for each of the {info.num_steps} steps",
            )
        metadata = {}
        if fields.language in record.located:
            metadata["language"] = b"".join(record.values(fields.language, "bytes_list")[:1]).decode(errors="replace")
        return Episode(
            info=info,
            states=_states_of(record, fields, info.num_steps, where),
            read_frames=JpegReader(pictures, where=f"{where}: {fields.cameras[self._config.camera]}"),
            control_rate_hz=fields.control_rate_hz,
            metadata=metadata,
        )

    def _require_distinct(self, infos: list[EpisodeInfo]) -> None:
        seen: dict[str, int] = {}
        for number, info in enumerate(infos):
            if info.id in seen and info.id not in self._config.exclude:
                error = InputError(
                    where=str(self._spans[number]),
                    found=f"the same identity as {self._spans[seen[info.id]]}: {info.id}",
                    needed="episodes that can be told apart: the split is a hash of the identity",
                    fix="Add a feature to data.fields.identity that differs between them",
                )
                raise with_way_out(error, [info.id])
            seen[info.id] = number


def _damage_or(error: InputError, span: RecordSpan) -> InputError:
    """Return what the CRC says, if it says that the record is damaged: then that is the error to show."""
    try:
        read_record(span)
    except InputError as damage:
        return damage
    return error


def _identity_of(record: Record, fields: RldsFields) -> str:
    parts = []
    for name in fields.identity:
        values = record.values(name, "bytes_list", "int64_list")
        parts += [value.decode(errors="replace") if isinstance(value, bytes) else str(value) for value in values]
    return IDENTITY_SEPARATOR.join(parts)


def _info_of(record: Record, fields: RldsFields) -> EpisodeInfo:
    identity = _identity_of(record, fields)
    success = True if "/success/" in identity else False if "/failure/" in identity else None
    return EpisodeInfo(id=identity, num_steps=_num_steps(record, fields), success=success)


def _num_steps(record: Record, fields: RldsFields) -> int:
    """Count the steps by their first flag; a data set without it by its states."""
    if _STEP_FLAG in record.located:
        return len(record.values(_STEP_FLAG, "int64_list"))
    return sum(len(record.values(name, "float_list")) for name in fields.state) // STATE_DIM


def _states_of(record: Record, fields: RldsFields, steps: int, where: str) -> Float[np.ndarray, "steps 7"]:
    columns = []
    for name in fields.state:
        values = np.asarray(record.values(name, "float_list"), dtype=np.float64)
        if steps == 0 or len(values) == 0 or len(values) % steps:
            raise InputError(
                where=f"{where}: {name}", found=f"{len(values)} numbers", needed=f"as many for each of {steps} steps"
            )
        columns.append(values.reshape(steps, -1))
    states = np.concatenate(columns, axis=1)
    if states.shape[1] != STATE_DIM:
        found = " + ".join(f"{name} [{column.shape[1]}]" for name, column in zip(fields.state, columns, strict=True))
        raise InputError(
            where=f"{where}: data.fields.state", found=found, needed=f"{STATE_DIM} numbers a step: xyz, Euler, gripper"
        )
    require_plausible(states, where, fix="Check data.fields.state")
    if fields.gripper == "openness":
        states[:, 6] = 1.0 - states[:, 6]
    return states
