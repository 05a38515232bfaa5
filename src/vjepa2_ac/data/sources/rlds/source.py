"""Source of RLDS episodes: one tf.train.Example each, read without TensorFlow, images on demand."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial

from vjepa2_ac import storage
from vjepa2_ac.config import RldsData
from vjepa2_ac.config.section import Affects, knobs_that_affect
from vjepa2_ac.data.index.index_cache import IndexKeys, cache_folder, get_or_build
from vjepa2_ac.data.sources.indexed_source import IndexedSource, Opened
from vjepa2_ac.data.sources.rlds import features
from vjepa2_ac.data.sources.rlds.crc_marks import CrcMarks
from vjepa2_ac.data.sources.rlds.dataset_info import find_shards
from vjepa2_ac.data.sources.rlds.example import ExampleRecord
from vjepa2_ac.data.sources.rlds.images import images_in_file, images_in_memory, wrong_count
from vjepa2_ac.data.sources.rlds.images_remote import RemoteCache, RemoteEpisode, whole_record
from vjepa2_ac.data.sources.rlds.index_local import index_local, position_of
from vjepa2_ac.data.sources.rlds.index_remote import index_remote
from vjepa2_ac.data.sources.rlds.shard_reader import Shard, open_shard
from vjepa2_ac.data.sources.rlds.tfrecord import RecordSpan, require_intact
from vjepa2_ac.data.sources.rlds.wire_format import Read
from vjepa2_ac.episode import Episode, EpisodeInfo, Progress, StepRanges


@dataclass(frozen=True)
class _Opened(Opened):
    shards: tuple[Shard, ...]
    verified: CrcMarks
    cache: RemoteCache


class RldsSource(IndexedSource[RldsData, _Opened]):
    """The episodes of an RLDS data set, in the order of its shards.

    `infos` scans every record once and caches the result; `read` reads the states only, and images are read and decoded
    on request. With `check_crc: once` a record is read completely the first time on this machine: its CRC is checked,
    and that each camera has one image for every step.

    Behind a URL only parts of a record are fetched, and parts have no CRC: checked are the CRCs of the lengths, the
    nesting of features and images, and the images' format; the rest is left to the transport. There `always` fetches
    complete records, every time, and checks their CRC.
    """

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return one episode.

        Raises:
            InputError: The record is damaged, has changed, lacks a feature, or has implausible states.
            UnreachableError: The network fails.
            ValueError: A camera that the config does not know.
        """
        opened, fields = self._open(), self._config.fields
        camera = camera or self._config.cameras[0]
        if camera not in fields.cameras:
            raise ValueError(f"camera {camera!r} is not one of {', '.join(fields.cameras)}")
        feature, info = fields.cameras[camera], opened.table[index]
        shard, span = position_of(opened.table, opened.shards, index)
        where = f"{span} ({info.id})"
        if not storage.is_url(shard.path):
            with open_shard(shard) as read:
                record = ExampleRecord(read, span)
                if self._config.check_crc != "once" or index not in opened.verified:
                    self._check(record, read, span, info, {feature, *self._image_features()})
                    if self._config.check_crc == "once":
                        opened.verified.add(index)
                record.require([feature])
                images = images_in_file(shard, record.located[feature], info.num_steps, f"{where}: {feature}")
                return features.episode_of(record, self._config, info, images, where)
        if self._config.check_crc == "always":
            read = whole_record(shard, span)
            record = ExampleRecord(read, span)
            self._check(record, read, span, info, {feature})
            images = images_in_memory(read, record.located[feature], info.num_steps, f"{where}: {feature}")
        else:
            remote = RemoteEpisode(shard, span, opened.cache)
            numbers = [*fields.identity, *features.step_features(self._config), features.STEP_FLAG]
            numbers += [fields.joint_velocity] if fields.joint_velocity else []
            record = remote.record(numbers, [fields.language] if fields.language else [])
            record.require([feature])
            place = record.located[feature]
            images = remote.images(feature, place, info.num_steps, needed, f"{where}: {feature}")
        return features.episode_of(record, self._config, info, images, where)

    def _check(
        self, record: ExampleRecord, read: Read, span: RecordSpan, info: EpisodeInfo, cameras: Iterable[str]
    ) -> None:
        """Check a complete record: its CRC, unless disabled, and the number of its images."""
        if self._config.check_crc != "never":
            require_intact(read, span)
        for feature in cameras:
            found = len(record.items(feature)[0])
            if found != info.num_steps:
                raise wrong_count(found, info.num_steps, f"{span} ({info.id}): {feature}")

    def _image_features(self) -> list[str]:
        """Return the features with the images of the config's cameras."""
        return [self._config.fields.cameras[camera] for camera in self._config.cameras]

    def _look(self, progress: Progress) -> _Opened:
        config, fields = self._config, self._config.fields
        shards = tuple(find_shards(config.path))
        parts = {
            **({"vector": features.step_features(config)} if config.states == "vector" else {}),
            "source": "rlds",
            **knobs_that_affect(Affects.INDEX, fields),
            "cameras": self._image_features(),
            "shards": [(shard.name, shard.episodes, shard.size, shard.version) for shard in shards],
        }
        parts.pop("action")  # where it matters, it is among the features
        keys = IndexKeys.of(parts, config.path)
        make = index_remote if storage.is_url(config.path) else index_local
        build = partial(make, shards, config, self._image_features(), threads=config.connections, progress=progress)
        table = get_or_build(config.disk_cache, keys, config.path, build)
        return _Opened(
            replace(table, texts={**table.texts, "control_rate_hz": str(fields.control_rate_hz)}),
            shards,
            CrcMarks(cache_folder(config.disk_cache) / "index" / f"{keys.now}.checked"),
            RemoteCache.of(config.disk_cache, keys.now),
        )
