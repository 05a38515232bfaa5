"""Data sets with several splits of their own: RLDS with a shard for each, LeRobot with ranges in meta/info.json."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from copied_sets import write_lerobot
from lerobot_sets import change_info
from synthetic import write_synthetic_droid

EPISODES = 4  # of each split of an RLDS set


def write_rlds_splits(folder: Path, *names: str) -> Path:
    """Write an RLDS set in which episode n belongs to the split names[n % len(names)]."""
    count = len(names)
    write_synthetic_droid(folder, episodes=EPISODES * count, steps=14, shards=count, size=(24, 32))
    info = json.loads((folder / "dataset_info.json").read_text())
    counts = [count for split in info["splits"] for count in split["shardLengths"]]
    info["splits"] = [{"name": name, "shardLengths": [of_shard]} for name, of_shard in zip(names, counts, strict=True)]
    shards = sorted(folder.glob("*.tfrecord-*"))
    for number, (name, shard) in enumerate(zip(names, shards, strict=True)):
        assert f"{number:05d}-of" in shard.name
        shard.rename(folder / f"{info['name']}-{name}.tfrecord-00000-of-00001")
    (folder / "dataset_info.json").write_text(json.dumps(info))
    return folder


def write_lerobot_splits(folder: Path, episodes: int, splits: Mapping[str, str]) -> Path:
    """Write a LeRobot set whose meta/info.json has these splits."""
    change_info(write_lerobot(folder, range(episodes)), splits=dict(splits))
    return folder
