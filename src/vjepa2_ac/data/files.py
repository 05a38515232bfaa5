"""The files of a data set: list them, read them with several threads, and cache remote files on the local disk."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TypeVar

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig, DiskCacheConfig
from vjepa2_ac.data.index import InvalidTableError, cache_folder, pack, unpack
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import FileInfo
from vjepa2_ac.storage.block_file import BlockCachedFile, DiskCache

CONNECTIONS = 16  # concurrent reads of remote data per process
MAX_DEPTH = 8  # levels of subfolders that are searched for episodes
_MAX_QUEUED = 4096  # submitted tasks; the limit saves memory for data sets of 100,000 episodes

Item = TypeVar("Item")
Result = TypeVar("Result")


open_cache = functools.cache(DiskCache)  # one instance per process and folder, so that a warning is logged once


def open_download_cache(config: DiskCacheConfig) -> DiskCache:
    """Return the disk cache of fetched data, which all sources and runs share, with one size limit."""
    return open_cache(cache_folder(config) / "fetched", int(config.limit_gb * 1e9))


class EpisodeFiles:
    """A reader of files that caches remote and parsed content on this machine, within `data.disk_cache.limit_gb`."""

    def __init__(self, config: DataConfig) -> None:
        self.cache = open_download_cache(config.disk_cache)

    def open(self, path: str, *, version: str) -> str | BlockCachedFile:
        """Return a local path unchanged, or open a remote file for partial reads with a cache of its blocks.

        Args:
            path: Local path or URL.
            version: Changes with the file's content; the size is requested once for each version.

        Raises:
            OSError: A file behind a URL does not exist or cannot be reached.
        """
        if not storage.is_url(path):
            return path
        size = self.cache.read_or_create(f"size {path} {version}", lambda: str(storage.file_size(path)).encode())
        return BlockCachedFile(path, version=version, size=int(size), cache=self.cache)

    def read(self, path: str, *, version: str) -> bytes:
        """Return the content of a file.

        Raises:
            InputError: There is no such file.
            UnreachableError: The file cannot be read now.
        """
        with storage.translate_read_errors(path, fix="Copy the episode again"):
            if storage.is_url(path):
                return self.cache.read_or_create(f"{path}@{version}", lambda: storage.read_bytes(path))
            return storage.read_bytes(path)

    def read_parsed(self, key: str, parse: Callable[[], Mapping[str, np.ndarray]]) -> Mapping[str, np.ndarray]:
        """Return the arrays that the disk cache has under a key, or parse them now and cache them."""
        if (data := self.cache.read(key)) is not None:
            with suppress(InvalidTableError):
                return unpack(data)[0]
        arrays = parse()
        self.cache.write(key, pack(arrays))
        return arrays


def num_connections(config: DataConfig) -> int:
    """Return the number of concurrent reads of a data set: several behind a URL, where latency dominates, else one."""
    return CONNECTIONS if storage.is_url(config.path) else 1


def map_in_threads(function: Callable[[Item], Result], items: Sequence[Item], connections: int) -> Iterator[Result]:
    """Apply a function to all items with several threads; yield the results in order or raise the first error."""
    if connections == 1 or len(items) < 2:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(min(connections, len(items)))
    try:
        for start in range(0, len(items), _MAX_QUEUED):
            yield from pool.map(function, items[start : start + _MAX_QUEUED])
    finally:
        pool.shutdown(cancel_futures=True)


def walk(root: str, connections: int) -> Iterator[tuple[str, FileInfo]]:
    """Yield (folder relative to `root`, file) of all files below `root`; names that begin with a dot are skipped.

    A folder that several links point to is visited once, so that none of its episodes has two identities.

    Raises:
        OSError: A folder cannot be listed.
        InputError: A name is not UTF-8.
    """
    folders, visited = [""], {storage.canonical_path(root)}
    for _ in range(MAX_DEPTH):
        subfolders: list[str] = []
        listings = map_in_threads(lambda folder: list_folder(root, folder), folders, connections)
        for folder, (files, names) in zip(folders, listings, strict=True):
            yield from ((folder, file) for file in files if not file.name.startswith("."))
            subfolders += [storage.join(folder, name) for name in names]
        paths = {storage.canonical_path(storage.join(root, folder)): folder for folder in reversed(subfolders)}
        folders = sorted(folder for path, folder in paths.items() if path not in visited)
        visited |= paths.keys()


def list_folder(root: str, folder: str) -> tuple[list[FileInfo], list[str]]:
    """Return the files in a folder, and the names of the folders in it except hidden ones.

    Raises:
        OSError: The folder cannot be listed.
        InputError: A name is not UTF-8.
    """
    path = storage.join(root, folder)
    entries = storage.list_folder(path)
    for entry in entries:  # the names become identities of episodes, which are stored as UTF-8
        if not entry.name.isascii() and any("\ud800" <= character <= "\udfff" for character in entry.name):
            raise InputError(
                where=path, found=f"the name {entry.name!r}", needed="names in UTF-8", fix="Rename the file or folder"
            )
    folders = [entry.name for entry in entries if not entry.is_file and not entry.name.startswith(".")]
    return [entry for entry in entries if entry.is_file], folders
