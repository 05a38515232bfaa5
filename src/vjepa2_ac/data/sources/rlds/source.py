"""Source of RLDS episodes: one tf.train.Example each, read without TensorFlow, images on demand."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.config import RldsData
from vjepa2_ac.config.section import Affects, knobs_that_affect
from vjepa2_ac.data.index import cache_folder, get_or_build, index_key
from vjepa2_ac.data.sources.indexed_source import IndexedSource, Opened
from vjepa2_ac.data.sources.rlds import episode
from vjepa2_ac.data.sources.rlds.images import RemoteEpisode, images_here
from vjepa2_ac.data.sources.rlds.index import build_index, position_of
from vjepa2_ac.data.sources.rlds.shards import Shard, find_shards, open_shard
from vjepa2_ac.data.sources.rlds.tfrecord import require_intact
from vjepa2_ac.episode import Episode, Progress, StepRanges

_CHECKED = b"\xc3"  # not all bits equal, so that a damaged file seldom contains false marks


@dataclass(frozen=True)
class _Opened(Opened):
    shards: tuple[Shard, ...]
    checked: Path  # a byte for each record whose CRC was checked on this machine, shared by all processes


class RldsSource(IndexedSource[RldsData, _Opened]):
    """The episodes of an RLDS data set, in the order of its shards.

    `infos` scans every record once and caches the result; `read` reads the states only, and images are read and decoded
    on request: each camera must have one for every step. With `check_crc: once` a local record is read completely the
    first time on this machine, and its CRC is checked.

    Behind a URL only parts of a record are fetched, and parts have no CRC: checked are the CRCs of the lengths, the
    nesting of features and images, and the images' format; the rest is left to the transport.
    """

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return one episode.

        Raises:
            InputError: The record is damaged, has changed, lacks a feature, or has implausible states.
            UnreachableError: The network fails.
            ValueError: A camera that the config does not know.
        """
        opened, config, fields = self._open(), self._config, self._config.fields
        camera = camera or config.cameras[0]
        if camera not in fields.cameras:
            raise ValueError(f"camera {camera!r} is not one of {', '.join(fields.cameras)}")
        feature, info = fields.cameras[camera], opened.table[index]
        shard, span = position_of(opened.table, opened.shards, index)
        where = f"{span} ({info.id})"
        if storage.is_url(shard.path):
            remote = RemoteEpisode(shard, span, config.disk_cache)
            names = [episode.STEP_FLAG, *episode.step_features(config), fields.joint_velocity, fields.language]
            record = remote.record([name for name in names if name])
            record.require([feature])
            place = record.located[feature]
            images = remote.images(feature, place, info.num_steps, needed, f"{where}: {feature}")
            return episode.episode_of(record, config, info, images, where)
        with open_shard(shard) as read:
            if config.check_crc == "always":
                require_intact(read, span)
            elif config.check_crc == "once" and not _is_marked(opened.checked, index):
                require_intact(read, span)
                _mark(opened.checked, index)
            record = episode.Record(read, span)
            record.require([feature])
            images = images_here(shard, record.located[feature], info.num_steps, f"{where}: {feature}")
            return episode.episode_of(record, config, info, images, where)

    def _look(self, progress: Progress) -> _Opened:
        config, fields = self._config, self._config.fields
        shards = tuple(find_shards(config.path))
        cameras = [fields.cameras[camera] for camera in config.cameras]
        parts = {
            "source": "rlds",
            "kinds": [config.states, config.actions],
            **knobs_that_affect(Affects.INDEX, fields),
            "cameras": cameras,
            "shards": [(shard.name, shard.episodes, shard.size, shard.version) for shard in shards],
        }
        key = index_key(parts, config.path)
        build = partial(build_index, shards, config, cameras, progress)
        table = get_or_build(config.disk_cache, key, config.path, build)
        table = replace(table, texts={**table.texts, "control_rate_hz": str(fields.control_rate_hz)})
        return _Opened(table, shards, cache_folder(config.disk_cache) / "index" / f"{key}.checked")


def _is_marked(file: Path, number: int) -> bool:
    """Return whether a record has been checked; a mark that cannot be read counts as missing."""
    try:
        with file.open("rb") as marks:
            marks.seek(number)
            return marks.read(1) == _CHECKED
    except OSError:
        return False


def _mark(file: Path, number: int) -> None:
    """Mark a record as checked; where that cannot be written, it is checked again next time."""
    with suppress(OSError):
        handle = os.open(file, os.O_WRONLY | os.O_CREAT, 0o666)
        try:
            os.pwrite(handle, _CHECKED, number)
        finally:
            os.close(handle)
