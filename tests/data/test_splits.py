"""The data set's own splits are used; a missing split is drawn by hash, and splits that are not used are reported."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from clips import split_of
from copied_sets import write_lerobot, write_rlds
from lerobot_sets import change_info
from synthetic import write_synthetic_droid
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.selection import describe_splits
from vjepa2_ac.errors import InputError
from vjepa2_ac.inspection.check import check_data

EPISODES = 4  # of each split of an RLDS set


def write_rlds_splits(folder: Path, *names: str) -> Path:
    """Write an RLDS set in which episode n belongs to the split names[n % len(names)]."""
    count = len(names)
    write_synthetic_droid(folder, episodes=EPISODES * count, steps=14, shards=count, size=(24, 32))
    info = json.loads((folder / "dataset_info.json").read_text())
    counts = [count for split in info["splits"] for count in split["shardLengths"]]
    info["splits"] = [
        {"name": name, "shardLengths": [num_episodes]} for name, num_episodes in zip(names, counts, strict=True)
    ]
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


SPLITS: tuple[Split, ...] = ("train", "validation", "test")
Opened = Callable[..., Dataset]


@pytest.fixture
def open_set(tmp_path: Path) -> Opened:
    """Open a data set with shares that draw some of 8 episodes."""

    def open_with(folder: Path, **changes: Any) -> Dataset:
        values = {
            "path": str(folder), "frames": 3, "stride": 2, "workers": 0, "validation_share": 0.3, "test_share": 0.3,
            "disk_cache": {"dir": str(tmp_path / "cache")},
        }  # fmt: skip
        return open_dataset(DataConfig.model_validate(values | changes))

    return open_with


def members(dataset: Dataset) -> dict[str, str]:
    """Return the split of each episode by its identity."""
    splits = {}
    for split in SPLITS:
        for index in dataset.split_mask(split).nonzero()[0].tolist():
            identity = dataset.table.identity(index)
            assert identity not in splits
            splits[identity] = split
    return splits


def numbers_in(dataset: Dataset, split: Split) -> set[int]:
    """Return the numbers of the synthetic episodes in a split."""
    return {
        int(name.split("episode_")[1][:4]) for name, episode_split in members(dataset).items() if episode_split == split
    }


@pytest.mark.parametrize("val", ["val", "valid", "validation", "Val"])
def test_rlds_splits_are_used(val: str, open_set: Opened, tmp_path: Path) -> None:
    dataset = open_set(write_rlds_splits(tmp_path / "set", "test", "train", val))
    assert [numbers_in(dataset, split) for split in ("test", "train", "validation")] == [
        set(range(start, 3 * EPISODES, 3)) for start in range(3)
    ]
    assert {int(index) for index in dataset.windows("test").episodes} == set(
        dataset.split_mask("test").nonzero()[0].tolist()
    )
    role = "validation" if val == "validation" else f"{val} (4 episodes) as validation"
    text = describe_splits(dataset.table, dataset.config)
    assert text.startswith("the data set's own: ")
    assert role in text
    assert "drawn" not in text


def test_missing_split_is_drawn_from_train_only(open_set: Opened, tmp_path: Path) -> None:
    dataset = open_set(write_rlds_splits(tmp_path / "set", "train", "train_2", "val"), test_share=0.4)
    assert numbers_in(dataset, "validation") == set(range(2, 3 * EPISODES, 3))
    by_hash = dataset.config.model_copy(update={"validation_share": 0.0})
    drawn = {name: split_of(name, by_hash) for name, split in members(dataset).items() if split != "validation"}
    assert drawn == {name: split for name, split in members(dataset).items() if split != "validation"}
    assert set(drawn.values()) == {"train", "test"}
    text = describe_splits(dataset.table, dataset.config)
    assert text == (
        "the data set's own: train (4 episodes), train_2 (4 episodes) as train, val (4 episodes) as validation;"
        " test is drawn from train by hash"
    )


@pytest.mark.parametrize(
    ("names", "changes", "reason"),
    [
        (("train", "val"), {"splits": "hash"}, "data.splits is hash"),
        (("part_1", "part_2"), {}, "they do not include both train and a held-out split"),
        (("val", "test"), {}, "they do not include both train and a held-out split"),
    ],
)
def test_unusable_splits_are_pooled_and_drawn_by_hash(
    names: tuple[str, ...], changes: dict[str, str], reason: str, open_set: Opened, tmp_path: Path
) -> None:
    dataset = open_set(write_rlds_splits(tmp_path / "set", *names), **changes)
    assert members(dataset) == {info.id: split_of(info.id, dataset.config) for info in dataset.table}
    text = describe_splits(dataset.table, dataset.config)
    assert f"because {reason}: " in text
    assert all(f"{name} (4 episodes)" in text for name in names)


def test_single_split_is_drawn_by_hash_with_the_same_index(open_set: Opened, tmp_path: Path) -> None:
    folder = write_rlds(tmp_path / "set", range(8))
    dataset, pooled = open_set(folder), open_set(folder, splits="hash")
    assert dataset.table.to_bytes() == pooled.table.to_bytes()
    assert "split" not in dataset.table.labels
    assert members(dataset) == {info.id: split_of(info.id, dataset.config) for info in dataset.table}
    assert describe_splits(dataset.table, dataset.config) == ""


def test_lerobot_splits_are_ranges_of_episode_numbers(open_set: Opened, tmp_path: Path) -> None:
    folder = write_lerobot_splits(tmp_path / "set", 6, {"train": "0:3", "val": "3:5", "test": "5:6"})
    splits = members(open_set(folder, source="lerobot"))
    assert [splits[f"episode_{number:06d}"] for number in range(6)] == [
        "train", "train", "train", "validation", "validation", "test",
    ]  # fmt: skip


def test_excluding_all_episodes_of_a_split_raises_with_the_config_key(open_set: Opened, tmp_path: Path) -> None:
    folder = write_rlds_splits(tmp_path / "set", "train", "val")
    held_out = [name for name, split in members(open_set(folder)).items() if split == "validation"]
    with pytest.raises(InputError, match=r"no validation episodes among 4 .*Set data\.splits: hash"):
        open_set(folder, exclude=tuple(held_out)).windows("validation")


def test_check_reports_the_used_splits(open_set: Opened, tmp_path: Path) -> None:
    config = open_set(write_rlds_splits(tmp_path / "set", "train", "test")).config
    findings = list(check_data(config, clips=2))
    assert [finding.text for finding in findings if finding.about == "splits"] == [
        "the data set's own: test (4 episodes), train (4 episodes); validation is drawn from train by hash"
    ]
    (advice,) = [finding.text for finding in findings if "cannot show whether" in finding.text]
    assert advice.endswith("data.splits=hash draws the test split from all episodes")
    single = config.model_copy(update={"path": str(write_rlds_splits(tmp_path / "one", "train")), "test_share": 0.1})
    assert "splits" not in {finding.about for finding in check_data(single, clips=2)}
