"""Where is kept what was found out about a data set, so that it is found out once?"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.config import DiskCacheConfig
from vjepa2_ac.data.table import EpisodeTable, NotATableError

logger = logging.getLogger(__name__)

_VERSION = 1  # of what is kept: another number makes all of it be found out again


def cache_folder(config: DiskCacheConfig) -> Path:
    """Return the folder for what is kept on this machine: the config's, $VJEPA2_AC_CACHE, or the user's cache folder."""
    if config.dir is not None:
        return Path(config.dir).expanduser()
    if named := os.environ.get("VJEPA2_AC_CACHE"):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vjepa2-ac"


def key_of(parts: Mapping[str, object]) -> str:
    """Return a short name for everything that something found out depends on."""
    text = json.dumps({"version": _VERSION, **parts}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def kept_or_built(config: DiskCacheConfig, key: str, build: Callable[[], EpisodeTable]) -> EpisodeTable:
    """Return the table kept under a key; build and keep it where there is none, or a damaged one."""
    path = cache_folder(config) / "index" / f"{key}.npz"
    try:
        return EpisodeTable.from_bytes(path.read_bytes())
    except FileNotFoundError:
        pass
    except (OSError, NotATableError) as error:
        logger.warning("%s: cannot be used (%s); the index is built again", path, error)
    table = build()
    try:
        storage.write_atomically(path, table.to_bytes())
    except OSError as error:
        logger.warning("%s: cannot be written (%s); the index will be built again next time", path, error)
    return table
