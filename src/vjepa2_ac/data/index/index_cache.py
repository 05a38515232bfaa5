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

import numpy as np

from vjepa2_ac import places, storage
from vjepa2_ac.config import DiskCacheConfig
from vjepa2_ac.data.index.episode_table import FORMAT, EpisodeTable, NotATableError
from vjepa2_ac.errors import InputError

logger = logging.getLogger(__name__)

T = TypeVar("T")

_CACHE = "VJEPA2_AC_CACHE"
_VERSION = 3  # of the cache: another number makes all of it be rebuilt
_CRC_BYTES = 4
_PLACE, _BEFORE = "place", "index before"  # among the texts of a table


@dataclass
class Usage:
    """The index files used while they were recorded."""

    rebuild: bool
    files: list[Path] = field(default_factory=list)


_watch: ContextVar[Usage | None] = ContextVar("watch", default=None)


@contextlib.contextmanager
def record_usage(*, rebuild: bool = False) -> Iterator[Usage]:
    """Record which files of the index are used within the block; with `rebuild`, none is read, and all are rebuilt."""
    token = _watch.set(watch := Usage(rebuild))
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


@dataclass(frozen=True)
class IndexKeys:
    """The keys of an index: what else is cached of these episodes depends on one of them.

    A folder of this machine is known by what it holds, wherever it lies: `now`. At a URL the place counts, too, for
    servers say little of versions. Earlier versions always counted it: what they cached is found under `before`.
    """

    now: str
    before: str

    @classmethod
    def of(cls, parts: Mapping[str, object], place: str, *, named: str = "") -> IndexKeys:
        """Return the keys of a data set at a place.

        Args:
            parts: Its files, and how they are read.
            place: Its folder.
            named: An episode's identity, where that depends on the name of the folder.
        """
        before = key_of({**parts, "path": storage.absolute(place)})
        return cls(before if storage.is_url(place) else key_of({**parts, "named": named}), before)


def fingerprints_of(table: EpisodeTable) -> tuple[str, ...]:
    """Return everything that the episodes depend on, as one text; then those that earlier versions gave them.

    It is the key of their index, or without an index, the known facts.
    """
    if "index" in table.texts:
        return tuple(dict.fromkeys(table.texts[key] for key in ("index", _BEFORE) if key in table.texts))
    digest = hashlib.sha256(json.dumps(dict(table.texts)).encode())
    columns = {name: column for name, column in vars(table).items() if isinstance(column, np.ndarray)}
    for name, column in sorted({**columns, **table.locators}.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(column).data)
    return (digest.hexdigest(),)


def get_or_build(
    config: DiskCacheConfig, keys: IndexKeys, place: str, build: Callable[[], EpisodeTable]
) -> EpisodeTable:
    """Return the table cached under a key; build and cache it if it is missing or damaged.

    The keys are among the table's `texts`. The format of the table is part of the file's name, not of the key: an index
    in another format is rebuilt, while latent caches and fetched data of the same files stay valid. Problems name files
    where they lay when they were found: as far as that was in `place`, they name them where they lie now.
    """

    def build_marked() -> EpisodeTable:
        former = _index_file(config, f"{keys.before}.table{FORMAT}")
        if keys.before != keys.now and not _is_rebuilt():
            with contextlib.suppress(OSError, NotATableError):
                return marked(EpisodeTable.from_bytes(_checked(former.read_bytes())))
        return marked(build())

    def marked(table: EpisodeTable) -> EpisodeTable:
        texts = {"index": keys.now, _BEFORE: keys.before, _PLACE: storage.absolute(place)}
        return replace(table, texts={**table.texts, **texts})

    name = f"{keys.now}.table{FORMAT}"
    table = get_or_make(config, name, build_marked, to_bytes=EpisodeTable.to_bytes, from_bytes=EpisodeTable.from_bytes)
    return _at(table, storage.absolute(place))


def _at(table: EpisodeTable, place: str) -> EpisodeTable:
    """Return the table of a data set that was moved, with its problems where they are now."""
    former = table.texts.get(_PLACE, place)
    problems = tuple(replace(one, where=one.where.replace(former, place, 1)) for one in table.problems)
    return replace(table, problems=problems)


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
    path = _index_file(config, key)
    if watch := _watch.get():
        watch.files.append(path)
    try:
        if not _is_rebuilt():
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


def _index_file(config: DiskCacheConfig, key: str) -> Path:
    return cache_folder(config) / "index" / f"{key}.index"


def _is_rebuilt() -> bool:
    watch = _watch.get()
    return watch is not None and watch.rebuild


def _checked(file: bytes) -> bytes:
    crc, content = file[:_CRC_BYTES], file[_CRC_BYTES:]
    if zlib.crc32(content).to_bytes(_CRC_BYTES, "little") != crc:
        raise NotATableError("it is damaged")
    return content
