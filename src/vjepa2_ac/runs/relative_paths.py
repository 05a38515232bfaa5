"""Base folder of the relative paths in a run's config: the folder that the run was started in."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import getitem
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_dict, config_as_flat_dict, parse_config
from vjepa2_ac.errors import InputError
from vjepa2_ac.places import BUILTIN, is_url
from vjepa2_ac.runs.folder import start_folders

DATA, BASE, RANGES = "data.path", "model.base", "data.idle.ranges"
ENCODER = "model.encoder.path"
REPLAYED, REPLAYED_RANGES = f"replay.{DATA}", f"replay.{RANGES}"
_OF_DATA = (DATA, RANGES, "data.cache_dir", "data.disk_cache.dir")
_PATHS = (*_OF_DATA, BASE, ENCODER, *(f"replay.{key}" for key in _OF_DATA))


def with_paths_from_start(config: Config, run: Path, *, needed: Sequence[str]) -> Config:
    """Return a run's config with relative paths that do not exist here resolved from the folder of the run's start.

    The config in the run's folder is not changed. For resuming a run see `require_start_folder`.

    Args:
        config: As `read_run_config` returns it.
        run: The run's folder.
        needed: Keys of paths that must exist.

    Raises:
        InputError: One of these does not exist there either.
    """
    flat, elsewhere = config_as_flat_dict(config), _seen_from_start(config, run)
    for key in needed:
        if _leads_nowhere(flat[key]) and key not in elsewhere:
            starts = " or ".join(dict.fromkeys(map(str, start_folders(run))))
            found = f"{flat[key]}: a relative path that leads nowhere from {Path.cwd()}"
            found += f", nor from {starts}, where the run was started" if starts else ""
            fix = f"Go to the folder in which {'it does' if starts else 'the run was started'}"
            fix += ", or name the data with --data CONFIG and a folder with --out" if key == DATA else ""
            raise InputError(where=f"{run}: {key}", found=found, fix=fix)
    if not elsewhere:
        return config
    values = config_as_dict(config)
    for key, path in elsewhere.items():
        *sections, name = key.split(".")
        reduce(getitem, sections, values)[name] = path
    return parse_config(values, where=str(run))


def require_start_folder(config: Config, run: Path) -> None:
    """Refuse to resume a run from another folder, where its relative paths do not exist.

    Raises:
        InputError: Names the folder.
    """
    for key, path in _seen_from_start(config, run).items():
        if key in {DATA, BASE, ENCODER, REPLAYED}:
            found = f"{config_as_flat_dict(config)[key]}: a relative path that leads nowhere from {Path.cwd()}"
            needed = f"the folder in which the run was started: there it is {path}"
            fix = f"Go to that folder: vjepa2-ac train {run.absolute()} --resume"
            raise InputError(where=f"{run}: {key}", found=found, needed=needed, fix=fix)


def _seen_from_start(config: Config, run: Path) -> dict[str, str]:
    """Return the paths, by their keys, that exist relative to a folder in which the run was started."""
    found: dict[str, str] = {}
    flat = config_as_flat_dict(config)
    for key in _PATHS:
        ranges = dict(zip((RANGES, REPLAYED_RANGES), config.data_sets, strict=False))
        unread = key in ranges and ranges[key].is_cache  # there it is only a name, part of the cache's key
        if unread or not _leads_nowhere(flat.get(key)):
            continue
        there = next((start / flat[key] for start in start_folders(run) if (start / flat[key]).exists()), None)
        if there is not None:
            found[key] = str(there)
    return found


def _leads_nowhere(path: str | None) -> bool:
    """Return whether this is a relative path that does not exist."""
    if path is None or is_url(path) or path.startswith(BUILTIN):
        return False
    here = Path(path)
    return not here.is_absolute() and not here.exists()
