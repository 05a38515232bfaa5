"""Source of RLDS episodes: one tf.train.Example each, read without TensorFlow, images on demand."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from vjepa2_ac import storage
from vjepa2_ac.config import RldsData
from vjepa2_ac.config.effects import Affects, knobs_that_affect
from vjepa2_ac.data.index.episode_table import EpisodeTable
from vjepa2_ac.data.index.index_cache import IndexKeys, cache_folder, get_or_build
from vjepa2_ac.data.sources.rlds.crc_marks import CrcMarks
from vjepa2_ac.data.sources.rlds.dataset_info import Shard, find_shards
from vjepa2_ac.data.sources.rlds.example import ExampleRecord
from vjepa2_ac.data.sources.rlds.features import (
    STEP_FLAG,
    commands_of,
    features_of_steps,
    identity_of,
    info_of,
    joint_velocities_of,
    language_of,
    num_steps_of,
    states_of,
)
from vjepa2_ac.data.sources.rlds.images_local import ImagesAt, LocalImages, wrong_count
from vjepa2_ac.data.sources.rlds.images_remote import RemoteCache, RemoteEpisode, whole_record
from vjepa2_ac.data.sources.rlds.index_local import index_local
from vjepa2_ac.data.sources.rlds.index_remote import index_remote
from vjepa2_ac.data.sources.rlds.shard_reader import open_shard
from vjepa2_ac.data.sources.rlds.tfrecord import RecordSpan, require_intact
from vjepa2_ac.data.sources.rlds.wire_format import Read
from vjepa2_ac.episode import Episode, EpisodeInfo, FrameReader, Progress, StepRanges
from vjepa2_ac.errors import InputError


@dataclass(frozen=True)
class _Opened:
    """The state of an indexed data set."""

    shards: tuple[Shard, ...]
    table: EpisodeTable
    verified: CrcMarks
    cache: RemoteCache


class RldsSource:
    """The episodes of an RLDS data set, in the order of its shards.

    Nothing is read before the first call. `infos` scans every record once and caches the result; `read` reads the
    states only, and images are read and decoded on request. With `check_crc: once` a record is read completely the
    first time on this machine: its CRC is checked, and that each camera has one image for every step.

    Behind a URL only parts of a record are fetched, and parts have no CRC: checked are the CRCs of the lengths, the
    nesting of features and images, and the images' format; the rest is left to the transport. There `always` fetches
    complete records, every time, and checks their CRC.
    """

    def __init__(self, config: RldsData) -> None:
        self._config = config
        self._known: _Opened | None = None
        self._opening = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Pickle for a loader worker, with the index."""
        return {"_config": self._config, "_known": self._known}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Unpickle in a loader worker."""
        self.__dict__ |= state
        self._opening = threading.Lock()

    def infos(self, progress: Progress | None = None) -> EpisodeTable:
        """Return identity, length and outcome of every usable episode.

        Raises:
            InputError: No data set, missing shards, or no episode that can be used.
        """
        return self._open(progress).table

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return one episode.

        Raises:
            InputError: The record is damaged, has changed, lacks a feature, or has implausible states.
            UnreachableError: The network fails.
            ValueError: A camera that the config does not know.
        """
        opened, fields = self._open(None), self._config.fields
        camera = camera or self._config.cameras[0]
        if camera not in fields.cameras:
            raise ValueError(f"camera {camera!r} is not one of {', '.join(fields.cameras)}")
        shard, span = _place_of(opened, index)
        if storage.is_url(shard.path):
            return self._read_remote(opened, shard, span, index, fields.cameras[camera], needed)
        return self._read_local(opened, shard, span, index, fields.cameras[camera])

    def _read_local(self, opened: _Opened, shard: Shard, span: RecordSpan, index: int, feature: str) -> Episode:
        info = opened.table[index]
        where = f"{span} ({info.id})"
        with open_shard(shard) as read:
            record = ExampleRecord(read, span)
            if self._config.check_crc != "once" or index not in opened.verified:
                self._check(record, read, span, info.num_steps, {feature, *self._features()}, where)
                if self._config.check_crc == "once":
                    opened.verified.add(index)
            record.require([feature])
            images = LocalImages(shard, record.located[feature], info.num_steps, f"{where}: {feature}")
            return self._episode(record, info, images, where)

    def _read_remote(
        self,
        opened: _Opened,
        shard: Shard,
        span: RecordSpan,
        index: int,
        feature: str,
        needed: StepRanges | None,
    ) -> Episode:
        fields, info = self._config.fields, opened.table[index]
        where = f"{span} ({info.id})"
        if self._config.check_crc == "always":
            read = whole_record(shard, span)
            record = ExampleRecord(read, span)
            self._check(record, read, span, info.num_steps, {feature}, where)
            images: FrameReader = ImagesAt(read, record.located[feature], info.num_steps, f"{where}: {feature}")
        else:
            remote = RemoteEpisode(shard, span, opened.cache)
            numbers = [*fields.identity, *features_of_steps(self._config), STEP_FLAG, fields.joint_velocity]
            record = remote.record([name for name in numbers if name], [fields.language] if fields.language else [])
            record.require([feature])
            images = remote.images(feature, record.located, info.num_steps, needed, f"{where}: {feature}")
        return self._episode(record, info, images, where)

    def _episode(self, record: ExampleRecord, info: EpisodeInfo, images: FrameReader, where: str) -> Episode:
        config, fields = self._config, self._config.fields
        _require_as_indexed(record, info, config, where)
        return Episode(
            info=info,
            states=states_of(record, config, info.num_steps, where),
            read_frames=images,
            control_rate_hz=fields.control_rate_hz,
            joint_velocities=joint_velocities_of(record, fields, info.num_steps, where),
            metadata=language_of(record, fields),
            commands=commands_of(record, config, info.num_steps, where),
        )

    def _check(
        self, record: ExampleRecord, read: Read, span: RecordSpan, num_steps: int, features: Iterable[str], where: str
    ) -> None:
        """Check a complete record: its CRC, unless disabled, and the number of its images."""
        if self._config.check_crc != "never":
            require_intact(read, span)
        for feature in features:
            found = len(record.items(feature)[0])
            if found != num_steps:
                raise wrong_count(found, num_steps, f"{where}: {feature}")

    def _features(self) -> list[str]:
        """Return the features with the images of the config's cameras."""
        return [self._config.fields.cameras[camera] for camera in self._config.cameras]

    def _open(self, progress: Progress | None) -> _Opened:
        with self._opening:
            if self._known is None:
                self._known = self._look(progress)
            return self._known

    def _look(self, progress: Progress | None) -> _Opened:
        config, fields = self._config, self._config.fields
        shards = tuple(find_shards(config.path))
        parts = {
            **({"vector": features_of_steps(config)} if config.states == "vector" else {}),
            "source": "rlds",
            **knobs_that_affect(Affects.INDEX, fields),
            "cameras": self._features(),
            "shards": [(shard.name, shard.episodes, shard.size, shard.version) for shard in shards],
        }
        parts.pop("action")  # where it matters, it is among the features
        keys = IndexKeys.of(parts, config.path)

        make = index_remote if storage.is_url(config.path) else index_local

        def build() -> EpisodeTable:
            return make(shards, config, self._features(), threads=config.connections, progress=progress)

        table = get_or_build(config.disk_cache, keys, config.path, build)
        return _Opened(
            shards,
            replace(table, texts={**table.texts, "control_rate_hz": str(fields.control_rate_hz)}),
            CrcMarks(cache_folder(config.disk_cache) / "index" / f"{keys.now}.checked"),
            RemoteCache.of(config.disk_cache, keys.now),
        )


def _place_of(opened: _Opened, index: int) -> tuple[Shard, RecordSpan]:
    at = {name: int(column[index]) for name, column in opened.table.locators.items()}
    shard = opened.shards[at["shard"]]
    return shard, RecordSpan(path=shard.path, number=at["record"], offset=at["offset"], length=at["length"])


def _require_as_indexed(record: ExampleRecord, info: EpisodeInfo, config: RldsData, where: str) -> None:
    """Refuse a record that does not match the index."""
    found = info_of(identity_of(record, config.fields), num_steps_of(record, config))
    if found != info:
        raise InputError(
            where=where,
            found=f"the episode {found.id} of {found.num_steps} steps",
            needed=f"{info.num_steps} steps of {info.id}, says the index",
            fix="Start again",
        )
