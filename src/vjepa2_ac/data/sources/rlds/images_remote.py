"""Reading an episode whose record is behind a URL, so that later clips of it are cheap.

Stored on this machine for ever, a few KB each: the positions of a record's features, and of the images in them. Stored
within the limit of `data.disk_cache`: states, and the images of steps that clips may come from, some dozens per file.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, UInt8

from vjepa2_ac.config import DiskCacheConfig
from vjepa2_ac.data.cache.disk_cache import DiskCache, fetched_data
from vjepa2_ac.data.index.index_cache import cache_folder
from vjepa2_ac.data.sources.rlds.dataset_info import Shard
from vjepa2_ac.data.sources.rlds.example import ExampleRecord
from vjepa2_ac.data.sources.rlds.images_local import require_steps, wrong_count
from vjepa2_ac.data.sources.rlds.range_reader import RemoteFile, read_in_parallel
from vjepa2_ac.data.sources.rlds.shard_reader import unreadable
from vjepa2_ac.data.sources.rlds.tfrecord import RecordSpan
from vjepa2_ac.data.sources.rlds.wire_format import Located, NotAnExampleError, Read, locate_items
from vjepa2_ac.episode import StepRanges
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.jpeg import decode_jpegs, looks_like_jpeg
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
        self._shard, self._span, self._cache = shard, span, cache
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
            kept = self._cache.contents.read(self._key)
            places: list[tuple[int, int]] = [*(located[name] for name in whole if name in located)]
            places += [self._head_of(located[name]) for name in texts if name in located]
            file.hold(list(_unpack(kept)) if kept is not None else [])
            pieces = file.pieces_of(places)
        except OSError as error:
            raise unreadable(self._shard, error) from None
        if kept is None:
            self._cache.contents.write(self._key, _pack(pieces))
        return ExampleRecord(file, self._span, located)

    def images(
        self, feature: str, located: Mapping[str, Located], num_steps: int, needed: StepRanges | None, where: str
    ) -> RemoteImages:
        """Return the reader of one camera's images.

        Args:
            feature: The camera's.
            located: Positions of the record's features.
            num_steps: Of the episode.
            needed: Steps whose images are cached; None: all.
            where: File, record, identity and feature, for messages.
        """
        keep = tuple((max(0, start), min(end, num_steps)) for start, end in needed or [(0, num_steps)])
        return RemoteImages(
            self._shard, located[feature], num_steps, keep, where, self._cache, f"{self._key} {feature}"
        )

    def _head_of(self, place: Located) -> tuple[int, int]:
        """Return enough of a feature for its first text, and a little more."""
        end = min(place.offset + min(place.length, _TEXT_BYTES) + _HOP_BYTES, self._shard.size)
        return place.offset, end - place.offset

    def _located(self, file: RemoteFile) -> dict[str, Located]:
        kept = self._cache.places.read(self._key)
        if kept is not None:
            return {name: Located(*place) for name, place in json_object(kept, where=self._key).items()}
        located = ExampleRecord(file, self._span).located
        self._cache.places.write(self._key, json.dumps(located).encode())
        return located


@dataclass(frozen=True)
class RemoteImages:
    """Reads requested images of one camera of one episode: from the cache, or from the URL.

    The first time all of the camera's images are fetched, because only that gives their positions; those of the needed
    steps are cached.
    """

    shard: Shard
    feature: Located
    num_steps: int
    needed: StepRanges
    where: str
    cache: RemoteCache
    key: str

    def __call__(self, steps: Sequence[int]) -> UInt8[np.ndarray, "time height width 3"]:
        """Return the RGB frames at these control steps, in this order.

        Raises:
            InputError: There is not one image for each step, one is not a JPEG, or differs in size.
            UnreachableError: The network fails.
            ValueError: No steps, or a step outside the episode.
        """
        require_steps(steps, self.num_steps, self.where)
        try:
            found = self._cached_or_fetched(sorted(set(steps)))
        except OSError as error:
            raise unreadable(self.shard, error) from None
        return decode_jpegs([found[step] for step in steps], steps, self.where)

    def _cached_or_fetched(self, steps: Sequence[int]) -> dict[int, bytes]:
        table = self.cache.places.read(self.key)
        if table is None:
            return self._first_time(steps)
        places = np.frombuffer(table, np.int64).reshape(-1, 2)
        found: dict[int, bytes] = {}
        for group in sorted({step // _GROUP_STEPS for step in steps}):
            kept = self.cache.contents.read(f"{self.key} {group}")
            found |= dict(_unpack(kept)) if kept is not None else {}
        missing = [step for step in steps if step not in found]
        return found | self._fetch(missing, places)

    def _fetch(self, steps: Sequence[int], places: Int64[np.ndarray, "steps 2"]) -> dict[int, bytes]:
        """Fetch single images, adjacent ones by one read."""
        runs: list[list[int]] = []
        for step in steps:
            if runs and int(places[step, 0]) - int(places[runs[-1][-1]].sum()) <= _GAP_BYTES:
                runs[-1].append(step)
            else:
                runs.append([step])
        wanted = [(int(places[run[0], 0]), int(places[run[-1]].sum() - places[run[0], 0])) for run in runs]
        found: dict[int, bytes] = {}
        for run, (start, _), piece in zip(runs, wanted, read_in_parallel(self.shard.path, wanted), strict=True):
            for step in run:
                offset, length = (int(value) for value in places[step])
                found[step] = piece[offset - start : offset - start + length]
        return found

    def _first_time(self, steps: Sequence[int]) -> dict[int, bytes]:
        """Fetch all of the camera's images, and cache their positions and the needed ones."""
        [data] = read_in_parallel(self.shard.path, [self.feature])
        start = self.feature.offset

        def read(offset: int, length: int) -> bytes:
            return data[offset - start : offset - start + length]

        try:
            offsets, lengths = locate_items(read, self.feature)
        except NotAnExampleError as error:
            raise InputError(where=self.where, found=str(error), needed="a list of images") from None
        if len(offsets) != self.num_steps:
            raise wrong_count(len(offsets), self.num_steps, self.where)
        images = [read(offset, length) for offset, length in zip(offsets, lengths, strict=True)]
        self.cache.places.write(self.key, np.array([offsets, lengths], np.int64).T.tobytes())
        groups: dict[int, list[tuple[int, bytes]]] = {}
        for step in (step for first, end in self.needed for step in range(first, end)):
            if looks_like_jpeg(images[step]):  # anything else may be a network error
                groups.setdefault(step // _GROUP_STEPS, []).append((step, images[step]))
        for group, members in groups.items():
            self.cache.contents.write(f"{self.key} {group}", _pack(members))
        return {step: images[step] for step in steps}


def whole_record(shard: Shard, span: RecordSpan) -> Read:
    """Return a complete record, with its CRC, as a read function.

    Raises:
        InputError: It cannot be read.
    """
    start = span.data_offset
    try:
        [data] = read_in_parallel(shard.path, [(start, span.end - start)])
    except OSError as error:
        raise unreadable(shard, error) from None
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
