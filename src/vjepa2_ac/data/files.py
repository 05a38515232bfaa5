"""The files of a data set: listed, read by several threads, and fetched once where they are behind a URL."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TypeVar

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig, DiskCacheConfig
from vjepa2_ac.data.index import NotATableError, cache_folder, pack, unpack
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import FileInfo
from vjepa2_ac.storage.block_file import BlockCachedFile, DiskCache

CONNECTIONS = 16  # concurrent reads of a process, for remote data
DEEPEST = 8  # folders below the data set's
_QUEUED = 4096  # results and tasks that wait at once: of a hundred thousand episodes not all

Item = TypeVar("Item")
Result = TypeVar("Result")


open_cache = functools.cache(DiskCache)  # one instance per process and folder: its warning is logged once


def fetched_data(config: DiskCacheConfig) -> DiskCache:
    """Return the cache of fetched data: one for all sources and runs, with one limit."""
    return open_cache(cache_folder(config) / "fetched", int(config.limit_gb * 1e9))


class EpisodeFiles:
    """Reads files; what comes from URLs or was parsed is cached on this machine, within `data.disk_cache.limit_gb`."""

    def __init__(self, config: DataConfig) -> None:
        self.cache = fetched_data(config.disk_cache)

    def open(self, path: str, *, version: str) -> str | BlockCachedFile:
        """Return what to open for partial reads: a local path itself, or a file of cached blocks.

        Args:
            path: Local path or URL.
            version: Changes with the file's content; the size is requested once for each version.

        Raises:
            OSError: A file behind a URL does not exist or cannot be reached.
        """
        if not storage.is_url(path):
            return path
        size = self.cache.read_or_make(f"size {path} {version}", lambda: str(storage.file_size(path)).encode())
        return BlockCachedFile(path, version=version, size=int(size), cache=self.cache)

    def read(self, path: str, *, version: str) -> bytes:
        """Return the content of a file.

        Raises:
            InputError: There is no such file; an UnreachableError if it cannot be read.
        """
        with storage.user_can_read(path, fix="Copy the episode again"):
            if storage.is_url(path):
                return self.cache.read_or_make(f"{path}@{version}", lambda: storage.read_bytes(path))
            return storage.read_bytes(path)

    def parsed(self, key: str, parse: Callable[[], Mapping[str, np.ndarray]]) -> Mapping[str, np.ndarray]:
        """Return arrays of an episode that were parsed on this machine before, or now."""
        if (data := self.cache.read(key)) is not None:
            with suppress(NotATableError):
                return unpack(data)[0]
        arrays = parse()
        self.cache.write(key, pack(arrays))
        return arrays


def connections_to(config: DataConfig) -> int:
    """Return how many files are read at once: behind a URL, where each is waited for, several."""
    return CONNECTIONS if storage.is_url(config.path) else 1


def in_parallel(function: Callable[[Item], Result], items: Sequence[Item], connections: int) -> Iterator[Result]:
    """Yield the result of a function for every item, in order, from several threads; or raise the first error."""
    if connections == 1 or len(items) < 2:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(min(connections, len(items)))
    try:
        for start in range(0, len(items), _QUEUED):
            yield from pool.map(function, items[start : start + _QUEUED])
    finally:
        pool.shutdown(cancel_futures=True)


def walk(root: str, connections: int) -> Iterator[tuple[str, FileInfo]]:
    """Yield all files, with their folder relative to `root`; names that begin with a dot are skipped.

    A folder with several links to it is visited once: its files would be episodes under several names.

    Raises:
        OSError: A folder cannot be listed.
        InputError: A name is not UTF-8.
    """
    folders, known = [""], {storage.absolute(root)}
    for _ in range(DEEPEST):
        below: list[str] = []
        listed = in_parallel(lambda folder: list_folder(root, folder), folders, connections)
        for folder, (files, names) in zip(folders, listed, strict=True):
            yield from ((folder, file) for file in files if not file.name.startswith("."))
            below += [storage.join(folder, name) for name in names]
        places = {storage.absolute(storage.join(root, folder)): folder for folder in reversed(below)}
        folders = sorted(folder for place, folder in places.items() if place not in known)
        known |= places.keys()


def list_folder(root: str, folder: str) -> tuple[list[FileInfo], list[str]]:
    """Return the files of a folder, and the names of its folders except hidden ones.

    Raises:
        OSError: It cannot be listed.
        InputError: A name is not UTF-8.
    """
    place = storage.join(root, folder)
    listed = storage.list_folder(place)
    for one in listed:  # the identity of an episode must be text that can be encoded
        if not one.name.isascii() and any("\ud800" <= letter <= "\udfff" for letter in one.name):
            raise InputError(where=place, found=f"the name {one.name!r}", needed="names in UTF-8", fix="Rename it")
    folders = [one.name for one in listed if not one.is_file and not one.name.startswith(".")]
    return [one for one in listed if one.is_file], folders
