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
_VERSION = 3  # of what is kept: another number makes all of it be found out again
_CRC_BYTES = 4


@dataclass
class Usage:
    """What of the index was used while somebody watched."""

    rebuild: bool
    files: list[Path] = field(default_factory=list)


_watch: ContextVar[Usage | None] = ContextVar("watch", default=None)


@contextlib.contextmanager
def record_usage(*, rebuild: bool = False) -> Iterator[Usage]:
    """Note which files of the index are used meanwhile; with `rebuild`, none is read: what they hold is made again."""
    watch = Usage(rebuild)
    token = _watch.set(watch)
    try:
        yield watch
    finally:
        _watch.reset(token)


def cache_folder(config: DiskCacheConfig) -> Path:
    """Return the folder for what is kept on this machine: the config's, $VJEPA2_AC_CACHE, or the user's.

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
    """Return a short name for everything that something found out depends on."""
    text = json.dumps({"version": _VERSION, **parts}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def get_or_build(config: DiskCacheConfig, key: str, build: Callable[[], EpisodeTable]) -> EpisodeTable:
    """Return the table kept under a key; build and keep it where there is none, or a damaged one.

    The key is among the table's `texts`, as `index`: what else is found out of these episodes depends on it. The form
    of the table is no part of the key, but of the file's name: an index of another form is built again, while latent
    caches and what was fetched of the same files stay good.
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
    """Return what is kept under a key; make and keep it where there is none, or it is damaged.

    It is damaged where it is not what was written, by a CRC, or `from_bytes` raises NotATableError.
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
