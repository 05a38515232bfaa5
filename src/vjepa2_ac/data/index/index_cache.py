"""The index cache: results of scanning a data set, so that it is scanned once."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from vjepa2_ac import places, storage
from vjepa2_ac.config import DiskCacheConfig
from vjepa2_ac.data.index.episode_table import FORMAT, EpisodeTable, NotATableError
from vjepa2_ac.errors import InputError

logger = logging.getLogger(__name__)

T = TypeVar("T")

_CACHE = "VJEPA2_AC_CACHE"
_VERSION = 3  # of the cache: another number makes all of it be rebuilt
_CRC_BYTES = 4


@dataclass
class Usage:
    """The index files used while they were recorded."""

    rebuild: bool
    files: list[Path] = field(default_factory=list)


_watch: ContextVar[Usage | None] = ContextVar("watch", default=None)


@contextlib.contextmanager
def record_usage(*, rebuild: bool = False) -> Iterator[Usage]:
    """Record which files of the index are used within the block; with `rebuild`, none is read, and all are rebuilt."""
    watch = Usage(rebuild)
    token = _watch.set(watch)
    try:
        yield watch
    finally:
        _watch.reset(token)


def cache_folder(config: DiskCacheConfig) -> Path:
    """Return the cache folder on this machine: the config's, $VJEPA2_AC_CACHE, or the user's.

    Raises:
        InputError: The environment names none.
    """
    if config.dir is not None:
        return Path(config.dir)
    if named := os.environ.get(_CACHE):
        try:
            return Path(places.on_this_machine(named))
        except ValueError as error:
            raise InputError(where=_CACHE, found=f"{named!r} {error}", needed="a folder of this machine") from None
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vjepa2-ac"


def key_of(parts: Mapping[str, object]) -> str:
    """Return a short key of everything that a cached result depends on."""
    text = json.dumps({"version": _VERSION, **parts}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def get_or_build(config: DiskCacheConfig, key: str, build: Callable[[], EpisodeTable]) -> EpisodeTable:
    """Return the table cached under a key; build and cache it if it is missing or damaged.

    The key is among the table's `texts`, as `index`: other cached results of these episodes depend on it. The format of
    the table is part of the file's name, not of the key: an index in another format is rebuilt, while latent caches
    and fetched data of the same files stay valid.
    """

    def build_marked() -> EpisodeTable:
        table = build()
        return replace(table, texts={**table.texts, "index": key})

    name = f"{key}.table{FORMAT}"
    return get_or_make(config, name, build_marked, to_bytes=EpisodeTable.to_bytes, from_bytes=EpisodeTable.from_bytes)


def get_or_make(
    config: DiskCacheConfig,
    key: str,
    make: Callable[[], T],
    *,
    to_bytes: Callable[[T], bytes],
    from_bytes: Callable[[bytes], T],
) -> T:
    """Return the object cached under a key; make and cache it if it is missing or damaged.

    It is damaged if its CRC is wrong, or `from_bytes` raises NotATableError.
    """
    path = cache_folder(config) / "index" / f"{key}.index"
    watch = _watch.get()
    if watch is not None:
        watch.files.append(path)
    try:
        if watch is None or not watch.rebuild:
            return from_bytes(_checked(path.read_bytes()))
    except FileNotFoundError:
        pass
    except (OSError, NotATableError) as error:
        logger.warning("%s: cannot be used (%s); the index is built again", path, error)
    made = make()
    content = to_bytes(made)
    try:
        storage.write_atomically(path, zlib.crc32(content).to_bytes(_CRC_BYTES, "little") + content)
    except OSError as error:
        logger.warning("%s: cannot be written (%s); the index will be built again next time", path, error)
    return made


def _checked(file: bytes) -> bytes:
    crc, content = file[:_CRC_BYTES], file[_CRC_BYTES:]
    if zlib.crc32(content).to_bytes(_CRC_BYTES, "little") != crc:
        raise NotATableError("it is damaged")
    return content
