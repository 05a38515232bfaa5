"""The dataset_info.json of an RLDS data set: which TFRecord shards make it up."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from vjepa2_ac import storage
from vjepa2_ac.data.sources.rlds.shard_reader import Shard
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import read_json_object

_INFO = "dataset_info.json"
_DEFAULT_TEMPLATE = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"
_MOST_NAMES = 5
_MOST_EPISODES = 100_000  # of a shard; DROID's have some 50


def find_shards(folder: str) -> list[Shard]:
    """Return the shards of every split that dataset_info.json lists, in its order; without empty shards.

    Raises:
        InputError: No data set, an unreadable or unsupported description, or missing shards (names them).
    """
    where = storage.join(folder, _INFO)
    info = _read_info(folder, where)
    if (form := info.get("fileFormat", "tfrecord")) != "tfrecord":
        raise InputError(where=where, found=f"fileFormat {form}", needed="tfrecord", fix="Convert it with TFDS")
    try:
        shards = [shard for split in info["splits"] for shard in _shards_of(folder, str(info["name"]), split)]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        found = f"not a description of a data set ({error!r})"
        raise InputError(where=where, found=found, needed="TFDS's own") from None
    if not shards:
        raise InputError(where=where, found="no episodes in any split", needed="a data set with episodes")
    return _as_listed(folder, shards)


def dataset_name(folder: str) -> str:
    """Return the name that a data set gives itself, whatever its folder is called.

    Raises:
        InputError: As of `find_shards`.
    """
    return str(_read_info(folder, storage.join(folder, _INFO)).get("name", ""))


def _read_info(folder: str, where: str) -> dict[str, Any]:
    try:
        return read_json_object(where, needed="a description as TFDS writes it")
    except FileNotFoundError:
        fix = "Set data.path to the data set; docs/QUICKSTART.md says how to get DROID"
        found, needed = _nothing_in(folder), f"a folder with {_INFO}"
        raise InputError(where="data.path", found=found, needed=needed, fix=fix) from None
    except OSError as error:
        raise storage.unreadable(where, error) from None


def _nothing_in(folder: str) -> str:
    names = storage.list_names(folder)
    if not names:
        return f"{folder} {'is empty' if storage.exists(folder) else 'does not exist'}"
    inner = [name for name in names if storage.exists(storage.join(storage.join(folder, name), _INFO))]
    if inner:
        return f"no {_INFO} in {folder}; did you mean {storage.join(folder, inner[0])}?"
    return f"no {_INFO} in {folder}, only {_shorten(names)}"


def _shards_of(folder: str, dataset: str, split: dict[str, Any]) -> list[Shard]:
    counts = [_count(count) for count in split.get("shardLengths", [])]
    template = split.get("filepathTemplate") or _DEFAULT_TEMPLATE
    shards = []
    for number, count in enumerate(counts):
        values = {
            "DATASET": dataset,
            "SPLIT": split["name"],
            "FILEFORMAT": "tfrecord",
            "SHARD_INDEX": f"{number:05d}",
            "NUM_SHARDS": f"{len(counts):05d}",
            "SHARD_X_OF_Y": f"{number:05d}-of-{len(counts):05d}",
        }
        name = template
        for key, value in values.items():
            name = name.replace("{" + key + "}", value)
        if count:
            shards.append(Shard(path=storage.join(folder, name), episodes=count))
    return shards


def _count(value: object) -> int:
    """Return the number of episodes of a shard: TFDS writes a number, or a string."""
    count = int(str(value))
    if not 0 <= count <= _MOST_EPISODES:
        raise ValueError(f"a shard of {count:,} episodes")
    return count


def _as_listed(folder: str, shards: list[Shard]) -> list[Shard]:
    """Return the shards with size and version, from one listing of the folder."""
    if len({shard.path for shard in shards}) < len(shards):
        needed = "a filepathTemplate that numbers them"
        raise InputError(where=storage.join(folder, _INFO), found="shards of one name", needed=needed)
    present = {file.name: file for file in storage.list_files(folder)}
    missing = [shard.name for shard in shards if shard.name not in present]
    if missing:
        found = f"{len(missing)} of {len(shards)} shards are missing: {_shorten(missing)}"
        raise InputError(where=folder, found=found, needed=f"every shard that {_INFO} lists", fix="Download them")
    return [replace(shard, size=present[shard.name].size, version=present[shard.name].version) for shard in shards]


def _shorten(names: list[str]) -> str:
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(names[:_MOST_NAMES]) + more
