"""The cache of remote data on this machine: files of episodes, whole or in parts, are fetched once."""

from __future__ import annotations

from collections.abc import Callable

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig, DiskCacheConfig
from vjepa2_ac.data.index.index_cache import cache_folder
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.block_file import BlockCachedFile, DiskCache


def fetched_data(config: DiskCacheConfig) -> DiskCache:
    """Return the cache of fetched data: one for all sources and runs, with one limit."""
    return DiskCache(cache_folder(config) / "fetched", int(config.limit_gb * 1e9))


class EpisodeFiles:
    """Reads files; data from URLs is cached on this machine, within `data.disk_cache.limit_gb`."""

    def __init__(self, config: DataConfig) -> None:
        self._cache = fetched_data(config.disk_cache)

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
        size = self._cached(f"size {path} {version}", lambda: str(storage.file_size(path)).encode())
        return BlockCachedFile(path, version=version, size=int(size), cache=self._cache)

    def read(self, path: str, *, version: str, where: str) -> bytes:
        """Return the content of a file.

        Args:
            path: Local path or URL.
            version: Changes with the file's content; for the cache of a URL.
            where: The file and its episode, for messages.

        Raises:
            InputError: There is no such file; an UnreachableError if a local one cannot be read.
            OSError: A file behind a URL cannot be read.
        """
        if not storage.is_url(path):
            return _read(path, where)
        return self._cached(f"{path}@{version}", lambda: _read(path, where))

    def _cached(self, key: str, fetch: Callable[[], bytes]) -> bytes:
        data = self._cache.read(key)
        if data is None:
            data = fetch()
            self._cache.write(key, data)
        return data


def _read(path: str, where: str) -> bytes:
    try:
        return storage.read_bytes(path)
    except FileNotFoundError:
        raise InputError(where=where, found="no such file", fix="Copy the episode again") from None
    except OSError as error:
        if storage.is_url(path):
            raise
        raise storage.unreadable(where, error) from None
