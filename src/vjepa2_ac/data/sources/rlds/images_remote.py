"""Reading an episode whose record is behind a URL, so that later clips of it are cheap.

Stored on this machine for ever, a few KB each: the positions of a record's features, and of the images in them. Stored
within the limit of `data.disk_cache`: states, and the images of steps that clips may come from, some dozens per file.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, UInt8

from vjepa2_ac.config import DiskCacheConfig
from vjepa2_ac.data.cache import fetched_data
from vjepa2_ac.data.index.index_cache import cache_folder
from vjepa2_ac.data.sources.indexed_source import FramesByStep
from vjepa2_ac.data.sources.rlds.example import ExampleRecord
from vjepa2_ac.data.sources.rlds.images import items_of, wrong_count
from vjepa2_ac.data.sources.rlds.shard_reader import RemoteFile, Shard, read_in_parallel
from vjepa2_ac.data.sources.rlds.tfrecord import RecordSpan
from vjepa2_ac.data.sources.rlds.wire_format import Located, Read
from vjepa2_ac.episode import StepRanges
from vjepa2_ac.media.jpeg import decode_jpegs, looks_like_jpeg
from vjepa2_ac.storage.block_file import DiskCache
from vjepa2_ac.storage.structured import json_object

_HOP_WINDOW = 1 << 16
_TEXT_BYTES = 512  # of a feature with one text per step, of which only the first is read
_HOP_BYTES = 32
_GROUP_STEPS = 64  # images of so many steps are one entry of the cache
_GAP_BYTES = 1 << 15  # images at most this far apart are fetched by one read
_FOR_EVER = 1 << 62


@dataclass(frozen=True)
class RemoteCache:
    """The local cache of one data set."""

    key: str  # of the index: changes with the files
    places: DiskCache  # positions of images in their files: small, without limit
    contents: DiskCache

    @classmethod
    def of(cls, config: DiskCacheConfig, key: str) -> RemoteCache:
        """Return the cache of the data set whose index has a key."""
        return cls(key, DiskCache(cache_folder(config) / "places", _FOR_EVER), fetched_data(config))


class RemoteEpisode:
    """One record behind a URL: its small features, and the images of its cameras.

    Args:
        shard: Its file.
        span: Its position in the file.
        cache: The cache of its data set.
    """

    def __init__(self, shard: Shard, span: RecordSpan, cache: RemoteCache) -> None:
        self._shard, self._span = shard, span
        self._places, self._contents = cache.places, cache.contents
        self._key = f"{cache.key} {shard.name} {span.offset}"  # independent of its position in a rebuilt index

    def record(self, whole: Sequence[str], texts: Sequence[str]) -> ExampleRecord:
        """Return the record with some features fetched, if it has them.

        Args:
            whole: Features to fetch completely: numbers, and the identity.
            texts: Features with a text per step, of which the first is enough.

        Raises:
            InputError: It cannot be read, or is no Example.
        """
        file = RemoteFile(self._shard, window=_HOP_WINDOW)
        try:
            located = self._located(file)
            cached = self._contents.read(self._key)
            places: list[tuple[int, int]] = [*(located[name] for name in whole if name in located)]
            places += [self._head_of(located[name]) for name in texts if name in located]
            file.hold(list(_unpack(cached)) if cached is not None else [])
            pieces = file.pieces_of(places)
        except OSError as error:
            raise self._shard.unreadable(error) from None
        if cached is None:
            self._contents.write(self._key, _pack(pieces))
        return ExampleRecord(file, self._span, located)

    def images(
        self, name: str, feature: Located, num_steps: int, needed: StepRanges | None, where: str
    ) -> FramesByStep:
        """Return the reader of one camera's images: from the cache, or from the URL.

        The first time all of the camera's images are fetched, because only that gives their positions; those of the
        needed steps are cached.

        Args:
            name: The feature's.
            feature: Its position.
            num_steps: Of the episode.
            needed: Steps whose images are cached; None: all.
            where: File, record, identity and feature, for messages.
        """
        key = f"{self._key} {name}"

        def decode(steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
            try:
                table = self._places.read(key)
                if table is None:
                    images = self._fetch_all(key, feature, needed, num_steps, where)
                else:
                    images = self._cached_or_fetched(key, np.frombuffer(table, np.int64).reshape(-1, 2), steps)
            except OSError as error:
                raise self._shard.unreadable(error) from None
            return decode_jpegs([images[step] for step in steps], steps, where)

        return FramesByStep(num_steps, where, decode)

    def _head_of(self, place: Located) -> tuple[int, int]:
        """Return enough of a feature for its first text, and a little more."""
        end = min(place.offset + min(place.length, _TEXT_BYTES) + _HOP_BYTES, self._shard.size)
        return place.offset, end - place.offset

    def _located(self, file: RemoteFile) -> dict[str, Located]:
        cached = self._places.read(self._key)
        if cached is not None:
            return {name: Located(*place) for name, place in json_object(cached, where=self._key).items()}
        located = ExampleRecord(file, self._span).located
        self._places.write(self._key, json.dumps(located).encode())
        return located

    def _cached_or_fetched(
        self, key: str, places: Int64[np.ndarray, "steps 2"], steps: Sequence[int]
    ) -> dict[int, bytes]:
        """Return images whose positions are known; adjacent ones are fetched by one read."""
        found: dict[int, bytes] = {}
        for group in sorted({step // _GROUP_STEPS for step in steps}):
            cached = self._contents.read(f"{key} {group}")
            found |= dict(_unpack(cached)) if cached is not None else {}
        runs: list[list[int]] = []
        for step in sorted(set(steps) - found.keys()):
            if runs and int(places[step, 0]) - int(places[runs[-1][-1]].sum()) <= _GAP_BYTES:
                runs[-1].append(step)
            else:
                runs.append([step])
        wanted = [(int(places[run[0], 0]), int(places[run[-1]].sum() - places[run[0], 0])) for run in runs]
        for run, (start, _), piece in zip(runs, wanted, read_in_parallel(self._shard.path, wanted), strict=True):
            for step in run:
                offset, length = (int(value) for value in places[step])
                found[step] = piece[offset - start : offset - start + length]
        return found

    def _fetch_all(
        self, key: str, feature: Located, needed: StepRanges | None, num_steps: int, where: str
    ) -> dict[int, bytes]:
        """Fetch all of a camera's images, and cache their positions and the needed ones."""
        read = _fetched(self._shard, *feature)
        offsets, lengths = items_of(read, feature, where)
        if len(offsets) != num_steps:
            raise wrong_count(len(offsets), num_steps, where)
        images = {step: read(*place) for step, place in enumerate(zip(offsets, lengths, strict=True))}
        self._places.write(key, np.array([offsets, lengths], np.int64).T.tobytes())
        groups: dict[int, list[tuple[int, bytes]]] = {}
        for first, end in needed or [(0, num_steps)]:
            for step in range(max(0, first), min(end, num_steps)):
                if looks_like_jpeg(images[step]):  # anything else may be a network error
                    groups.setdefault(step // _GROUP_STEPS, []).append((step, images[step]))
        for group, members in groups.items():
            self._contents.write(f"{key} {group}", _pack(members))
        return images


def whole_record(shard: Shard, span: RecordSpan) -> Read:
    """Return a complete record, with its CRC, as a read function.

    Raises:
        InputError: It cannot be read.
    """
    try:
        return _fetched(shard, span.data_offset, span.end - span.data_offset)
    except OSError as error:
        raise shard.unreadable(error) from None


def _fetched(shard: Shard, start: int, length: int) -> Read:
    """Fetch a part of a file completely, and return how to read it."""
    [data] = read_in_parallel(shard.path, [(start, length)])
    return lambda offset, length: data[offset - start : offset - start + length]


def _pack(parts: Sequence[tuple[int, bytes]]) -> bytes:
    """Return numbered bytes as one piece of bytes."""
    head = struct.pack("<I", len(parts)) + b"".join(struct.pack("<QI", number, len(data)) for number, data in parts)
    return head + b"".join(data for _, data in parts)


def _unpack(packed: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the arguments of `_pack`."""
    [count] = struct.unpack_from("<I", packed)
    position = 4 + 12 * count
    for number, length in struct.iter_unpack("<QI", packed[4:position]):
        yield number, packed[position : position + length]
        position += length
