"""How is a small file read whole, and not fetched twice when it lies elsewhere?"""

from __future__ import annotations

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.disk_cache import DiskCache
from vjepa2_ac.data.index import cache_folder
from vjepa2_ac.errors import InputError


class WholeFiles:
    """Reads files; those behind URLs are kept on this machine, within `data.disk_cache.limit_gb`."""

    def __init__(self, config: DataConfig) -> None:
        folder = cache_folder(config.disk_cache) / "files"
        self._cache = DiskCache(folder, int(config.disk_cache.limit_gb * 1e9))

    def read(self, path: str, *, version: str, where: str) -> bytes:
        """Return a whole file.

        Args:
            path: Local path or URL.
            version: What tells apart the contents that the file has had; for what is kept of a URL.
            where: The file and its episode, as an error names them.

        Raises:
            InputError: There is no such file, or a local one cannot be read.
            OSError: A file behind a URL cannot be read.
        """
        if not storage.is_url(path):
            return _read(path, where)
        key = f"{path}@{version}"
        data = self._cache.read(key)
        if data is None:
            data = _read(path, where)
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
        raise InputError(where=where, found=f"cannot be read: {error.strerror}") from None
