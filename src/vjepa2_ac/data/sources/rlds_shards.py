"""The shards of an RLDS data set: list them from dataset_info.json, and read parts of them."""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from vjepa2_ac import storage
from vjepa2_ac.data.selection import format_identities
from vjepa2_ac.data.sources.tfrecord import ReadBytes
from vjepa2_ac.errors import InputError, MissingFileError
from vjepa2_ac.storage.structured import read_json_object

NEEDED_FILE = "a TFRecord file"
_INFO = "dataset_info.json"
_DEFAULT_TEMPLATE = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"
_MAX_EPISODES = 100_000  # limit per shard; DROID's shards have about 50
_WINDOW_BYTES = 1 << 15  # transferring this many bytes takes as long as the latency of a request
_WINDOWS = 8  # number of recent windows that are kept, for example the head of the next record


@dataclass(frozen=True)
class Shard:
    """One TFRecord file of a data set, and its expected number of episodes."""

    path: str
    episodes: int
    size: int  # bytes
    version: str  # from `storage.list_files`; changes with the content
    split: str  # name of the split in the data set

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.rsplit("/", 1)[-1]


def find_shards(folder: str) -> list[Shard]:
    """Return the non-empty shards of all splits, in the order of dataset_info.json.

    Raises:
        InputError: There is no data set, its description is invalid or unsupported, or shards are missing.
    """
    where = storage.join(folder, _INFO)
    info = _read_info(folder, where)
    if (file_format := info.get("fileFormat", "tfrecord")) != "tfrecord":
        raise InputError(
            where=where, found=f"fileFormat {file_format}", needed="tfrecord", fix="Convert the data set with TFDS"
        )
    try:
        expected_shards = [shard for split in info["splits"] for shard in _list_shards(split, str(info["name"]))]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problem = f"not a valid data set description ({error!r})"
        raise InputError(where=where, found=problem, needed=f"a {_INFO} as written by TFDS") from None
    if not expected_shards:
        raise InputError(where=where, found="no episodes in any split", needed="a data set with episodes")
    names = [name for name, *_ in expected_shards]
    files = {file.name: file for file in storage.list_files(folder)}
    if missing := [name for name in names if name not in files]:
        problem = f"{len(missing)} of {len(names)} shards are missing: {format_identities(missing)}"
        fix = f"Download them, or rename the existing files to the names in {_INFO}"
        raise InputError(where=folder, found=problem, needed=f"every shard that {_INFO} lists", fix=fix)
    return [
        Shard(storage.join(folder, name), count, files[name].size, files[name].version, split)
        for name, count, split in expected_shards
    ]


def read_dataset_name(folder: str) -> str:
    """Return the name of a data set in dataset_info.json, which may differ from the name of its folder.

    Raises:
        InputError: As `find_shards`.
    """
    return str(_read_info(folder, storage.join(folder, _INFO)).get("name", ""))


def _read_info(folder: str, where: str) -> dict[str, Any]:
    try:
        return read_json_object(where, needed=f"a {_INFO} as written by TFDS")
    except MissingFileError:
        fix = "Set data.path to the data set; docs/QUICKSTART.md describes how to download DROID"
        problem, needed = _describe_missing_info(folder), f"a folder with {_INFO}"
        raise InputError(where="data.path", found=problem, needed=needed, fix=fix) from None


def _describe_missing_info(folder: str) -> str:
    names = storage.list_names(folder)
    if not names:
        return f"{folder} {'is empty' if storage.exists(folder) else 'does not exist'}"
    paths = [storage.join(folder, name) for name in names]
    subfolders = [path for path in paths if storage.exists(storage.join(path, _INFO))]
    if subfolders:
        return f"no {_INFO} in {folder}; did you mean {format_identities(subfolders)}?"
    return f"no {_INFO} in {folder}, which contains {format_identities(names)}"


def _list_shards(split: dict[str, Any], dataset: str) -> Iterator[tuple[str, int, str]]:
    """Yield (name, number of episodes, split) of each shard; TFDS writes numbers as numbers or as strings."""
    counts = [int(str(count)) for count in split.get("shardLengths", [])]
    for number, count in enumerate(counts):
        if not 0 <= count <= _MAX_EPISODES:
            raise ValueError(f"a shard of {count:,} episodes")
        index, total = f"{number:05d}", f"{len(counts):05d}"
        values = {
            "DATASET": dataset,
            "SPLIT": str(split["name"]),
            "FILEFORMAT": "tfrecord",
            "SHARD_INDEX": index,
            "NUM_SHARDS": total,
            "SHARD_X_OF_Y": f"{index}-of-{total}",
        }
        template = split.get("filepathTemplate") or _DEFAULT_TEMPLATE
        if count:
            name = re.sub(r"\{(\w+)\}", lambda match, values=values: values.get(match[1], match[0]), template)
            yield name, count, values["SPLIT"]


@contextmanager
def open_shard(shard: Shard) -> Iterator[ReadBytes]:
    """Open a shard for reads of small parts.

    Several threads may read a local shard concurrently, but only one thread a remote shard. The file is not mapped
    into memory, so that truncating a local file during use causes short reads, not a crash.

    Raises:
        InputError: The file cannot be read, or a local one has changed since the data set was opened.
        UnreachableError: The network fails.
    """
    with storage.translate_read_errors(shard.path, needed=NEEDED_FILE):
        if storage.is_url(shard.path):
            yield _RemoteWindows(shard)
            return
        handle = os.open(shard.path, os.O_RDONLY)
        try:
            status = os.fstat(handle)
            if (status.st_size, str(status.st_mtime_ns)) != (shard.size, shard.version):
                problem = f"{status.st_size:,} bytes: the file has changed since the data set was opened"
                needed = f"the original file of {shard.size:,} bytes"
                raise InputError(where=shard.path, found=problem, needed=needed, fix="Run the command again")
            yield lambda offset, length: os.pread(handle, length, offset)
        finally:
            os.close(handle)


class _RemoteWindows:
    """A reader of a shard behind a URL that fetches windows and keeps the most recent ones."""

    def __init__(self, shard: Shard) -> None:
        self._shard = shard
        self._windows: deque[tuple[int, bytes]] = deque(maxlen=_WINDOWS)

    def __call__(self, offset: int, length: int) -> bytes:
        length = min(length, self._shard.size - offset)
        for start, window in self._windows:
            if start <= offset and offset + length <= start + len(window):
                return window[offset - start : offset - start + length]
        if length <= 0:
            return b""
        window_length = min(max(length, _WINDOW_BYTES), self._shard.size - offset)
        self._windows.append((offset, storage.read_range(self._shard.path, offset, window_length)))
        return self._windows[-1][1][:length]
