"""Source of RLDS episodes. Each is one tf.train.Example, read without TensorFlow; images are read on request.

For a record behind a URL, the positions of its features and images are cached on this machine without limit (about 4 KB
per episode). The numbers, and the images of steps that clips may come from, are cached within the limit of
`data.disk_cache`. The first read fetches all images of the camera, because their positions are unknown until then.
Later reads fetch only the images of a clip that are not cached. Blocks of a fixed size would transfer several times as
much data.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import DiskCacheConfig, RldsData
from vjepa2_ac.data.files import open_cache, open_download_cache
from vjepa2_ac.data.index import EpisodeTable, cache_folder, get_or_build_index, index_key
from vjepa2_ac.data.selection import add_split_labels
from vjepa2_ac.data.sources.indexed_source import IndexedSource, make_frame_reader
from vjepa2_ac.data.sources.rlds_episode import (
    STEP_FLAG,
    Record,
    build_index,
    list_step_features,
    locate_record,
    read_episode,
)
from vjepa2_ac.data.sources.rlds_shards import NEEDED_FILE, Shard, find_shards, open_shard
from vjepa2_ac.data.sources.tfrecord import ByteRange, NotAnExampleError, ReadBytes, RecordSpan, find_items, verify_crc
from vjepa2_ac.episode import Episode, FrameReader, Progress, StepRanges
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.media.images import decode_images
from vjepa2_ac.storage.remote import read_adjacent_ranges

_CHECKED = b"\xc3"  # neither 0x00 nor 0xff, so that a damaged file seldom contains false marks
_GAP_BYTES = 1 << 15  # images at most this far apart are fetched with one request
_CHUNK_BYTES = 1 << 20  # all of a camera's images are fetched in parallel chunks of this size


class RldsSource(IndexedSource[RldsData, tuple[Shard, ...]]):
    """The episodes of an RLDS data set, in the order of its shards.

    `infos` scans every record once and caches the result. `read` reads only the states; images are read and decoded on
    request, and each camera must have one image per step. The first time on this machine, a local record is read
    completely and its CRC is checked.

    Behind a URL only parts of a record are fetched, which have no CRC. The CRCs of the lengths, the nesting of features
    and images, and the format of images are checked. Other damage is only prevented by the network protocol.
    """

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return an episode.

        Raises:
            InputError: The record is damaged, has changed, lacks a feature, or has implausible states.
            UnreachableError: The network fails.
        """
        table, shards = self._open()
        config, fields = self._config, self._config.fields
        camera = camera or config.cameras[0]
        feature, info = fields.cameras[camera], table[index]
        shard, span = locate_record(table, shards, index)
        where = f"{span} ({info.id})"
        images_where = f"{where}: {feature}"
        if storage.is_url(shard.path):
            remote = RemoteEpisode(shard, span, config.disk_cache)
            names = [STEP_FLAG, *list_step_features(config), fields.joint_velocity, fields.language]
            record = remote.fetch_record([name for name in names if name])
            byte_range = record.find_feature(feature)
            images = remote.make_image_reader(feature, byte_range, info.num_steps, needed, images_where)
            return read_episode(record, config, info, images, where)
        with open_shard(shard) as read:
            checked = cache_folder(config.disk_cache) / "index" / f"{table.texts['index']}.checked"
            if not _is_checked(checked, index):
                verify_crc(read, span)
                _mark_checked(checked, index)
            record = Record(read, span)
            images = make_local_image_reader(shard, record.find_feature(feature), info.num_steps, images_where)
            return read_episode(record, config, info, images, where)

    def _open_data_set(self, progress: Progress) -> tuple[EpisodeTable, tuple[Shard, ...]]:
        config, fields = self._config, self._config.fields
        shards = tuple(find_shards(config.path))
        cameras = [fields.cameras[camera] for camera in config.cameras]
        parts = {
            "source": "rlds",
            "kinds": [config.states, config.actions],
            **fields.model_dump(mode="json", exclude={"language", "joint_velocity", "control_rate_hz"}),
            "cameras": cameras,
            "shards": [(shard.name, shard.episodes, shard.size, shard.version) for shard in shards],
        }
        key = index_key(parts, config.path)
        build = partial(build_index, shards, config, cameras, progress)
        table = get_or_build_index(config.disk_cache, key, config.path, build)
        table = add_split_labels(table, [shards[number].split for number in table.locators["shard"].tolist()])
        return replace(table, texts={**table.texts, "control_rate_hz": str(fields.control_rate_hz)}), shards


def _is_checked(file: Path, number: int) -> bool:
    """Return whether a record has been checked; a mark that cannot be read counts as missing."""
    try:
        with file.open("rb") as marks:
            marks.seek(number)
            return marks.read(1) == _CHECKED
    except OSError:
        return False


def _mark_checked(file: Path, number: int) -> None:
    """Mark a record as checked; if the mark cannot be written, the record is checked again next time."""
    with suppress(OSError):
        handle = os.open(file, os.O_WRONLY | os.O_CREAT, 0o666)
        try:
            os.pwrite(handle, _CHECKED, number)
        finally:
            os.close(handle)


def make_local_image_reader(shard: Shard, feature: ByteRange, num_steps: int, where: str) -> FrameReader:
    """Return a reader of the images in a local shard; `where` (file, record, identity, feature) is for messages."""

    def decode(steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        with open_shard(shard) as read:
            ranges = _find_images(read, feature, num_steps, where)
            return decode_images([read(*ranges[step]) for step in steps], steps, where)

    return make_frame_reader(num_steps, where, decode)


class RemoteEpisode:
    """One record behind a URL: its numbers, and the images of its cameras.

    Args:
        shard: The file of the record.
        span: The position of the record in the file.
        config: Config of the disk cache.
    """

    def __init__(self, shard: Shard, span: RecordSpan, config: DiskCacheConfig) -> None:
        self._shard, self._span = shard, span
        self._positions, self._contents = open_cache(cache_folder(config) / "places", None), open_download_cache(config)
        self._key = f"{shard.path} {shard.version} {shard.size} {span.offset}"

    def fetch_record(self, names: Sequence[str]) -> Record:
        """Fetch the features with these names, and return the record; missing features are ignored.

        Raises:
            InputError: The record cannot be read, or is not an Example.
            UnreachableError: The network fails.
        """
        feature_ranges = self._find_features()
        ranges = [feature_ranges[name] for name in names if name in feature_ranges]
        key = f"{self._key} {' '.join(names)}"
        with storage.translate_read_errors(self._shard.path, needed=NEEDED_FILE):
            data = self._contents.read_or_create(key, lambda: b"".join(storage.read_ranges(self._shard.path, ranges)))
        ends = np.cumsum([length for _, length in ranges]).tolist()
        pieces = {
            (offset, length): data[end - length : end] for (offset, length), end in zip(ranges, ends, strict=True)
        }
        return Record(lambda *byte_range: pieces[byte_range], self._span, feature_ranges)

    def make_image_reader(
        self, name: str, feature: ByteRange, num_steps: int, needed: StepRanges | None, where: str
    ) -> FrameReader:
        """Return a reader of one camera's images.

        Args:
            name: The name of the feature.
            feature: The position of the feature.
            num_steps: Number of steps of the episode.
            needed: Steps whose images are stored in the cache; None: all.
            where: File, record, identity and feature, for messages.
        """
        key = f"{self._key} {name}"

        def decode(steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
            with storage.translate_read_errors(self._shard.path, needed=NEEDED_FILE):
                stored = self._positions.read(key)
                if stored is None:
                    images = self._fetch_all(key, feature, num_steps, needed, where)
                else:
                    ranges = np.frombuffer(stored, np.uint32).reshape(-1, 2) + np.array([feature[0], 0])
                    images = self._read_images(key, list(map(tuple, ranges.tolist())), steps)
            return decode_images([images[step] for step in steps], steps, where)

        return make_frame_reader(num_steps, where, decode)

    def _find_features(self) -> dict[str, ByteRange]:
        def locate() -> bytes:
            with open_shard(self._shard) as read:
                return json.dumps(Record(read, self._span).feature_ranges).encode()

        feature_ranges = json.loads(self._positions.read_or_create(self._key, locate))
        return {name: tuple(byte_range) for name, byte_range in feature_ranges.items()}

    def _fetch_all(
        self, key: str, feature: ByteRange, num_steps: int, needed: StepRanges | None, where: str
    ) -> dict[int, bytes]:
        """Fetch all images of a camera; cache their positions and the images of the needed steps."""
        start, end = feature[0], sum(feature)
        chunks = [(offset, min(_CHUNK_BYTES, end - offset)) for offset in range(start, end, _CHUNK_BYTES)]
        data = b"".join(storage.read_ranges(self._shard.path, chunks))

        def read(offset: int, length: int) -> bytes:
            return data[offset - start : offset - start + length]

        ranges = _find_images(read, feature, num_steps, where)
        self._positions.write(key, (np.array(ranges) - (start, 0)).astype(np.uint32).tobytes())
        images = {step: read(*byte_range) for step, byte_range in enumerate(ranges)}
        steps = {step for first, stop in needed or [(0, num_steps)] for step in range(first, stop)}
        self._contents.write_parts(key, [image if step in steps else b"" for step, image in images.items()])
        return images

    def _read_images(self, key: str, ranges: list[ByteRange], steps: Sequence[int]) -> dict[int, bytes]:
        """Return images with known positions from the cache, or fetch them; one request fetches neighbouring images."""
        images = dict(zip(steps, self._contents.read_parts(key, len(ranges), steps) or [b""] * len(steps), strict=True))
        missing_steps = sorted(step for step, image in images.items() if not image)
        fetched = read_adjacent_ranges(self._shard.path, [ranges[step] for step in missing_steps], _GAP_BYTES)
        return images | dict(zip(missing_steps, fetched, strict=True))


def _find_images(read: ReadBytes, feature: ByteRange, num_steps: int, where: str) -> list[ByteRange]:
    """Return the position of each image of a feature.

    Raises:
        InputError: The feature is not a list of images, or does not have one image per step.
    """
    try:
        ranges = find_items(read, feature, num_steps + 1)
    except NotAnExampleError as error:
        raise InputError(where=where, found=str(error), needed="a list of images") from None
    if len(ranges) != num_steps:
        problem = f"{len(ranges)} images" if len(ranges) < num_steps else f"more than {counted(num_steps, 'image')}"
        needed = f"one image for each of the {counted(num_steps, 'step')}"
        raise InputError(where=where, found=problem, needed=needed)
    return ranges
