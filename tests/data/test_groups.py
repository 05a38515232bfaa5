"""Each group is in one split; unknown fields and episodes without a group raise an error."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clips import open_memory_source, split_of
from copied_sets import write_lerobot, write_npz, write_raw, write_rlds
from latent_sets import write_cache
from memory_source import MemorySource
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.errors import InputError

DROID = "gs://xembodiment_data/r2d2/r2d2-data-full/{lab}/{outcome}/{day}/Fri_Jul__7_09:42:23_2023/{number}--{number}.h5"
NAMES = [
    DROID.format(
        lab=f"LAB{n % 3}", outcome="failure" if n % 5 == 4 else "success", day=f"2023-07-{n % 7:02d}", number=n
    )
    for n in range(60)
]
SHARES = {"validation_share": 0.3, "test_share": 0.2}


def config_of(**changes: Any) -> DataConfig:
    return DataConfig.model_validate({"path": "somewhere", "frames": 3, "stride": 2, "workers": 0, **SHARES, **changes})


def open_set(names: list[str] | None = None, **changes: Any) -> Dataset:
    names = NAMES if names is None else names
    return open_memory_source(MemorySource([20] * len(names), names=names), **(SHARES | changes))


def splits_of(dataset: Dataset) -> dict[str, str]:
    """Return the split of every episode, determined from the clips of each split."""
    return {
        dataset.table.identity(int(index)): split
        for split in ("train", "validation", "test")
        for index in dataset.windows(split).episodes  # type: ignore[arg-type]
    }


def splits_by_group(dataset: Dataset, group_of: Any) -> dict[str, set[str]]:
    splits = defaultdict(set)
    for name, split in splits_of(dataset).items():
        splits[group_of(name)].add(split)
    return dict(splits)


@pytest.mark.parametrize("split_by", ["day", r"/(\d{4}-\d\d-\d\d)/"])
def test_episodes_of_a_group_are_in_the_same_split(split_by: str) -> None:
    dataset = open_set(split_by=split_by)
    days = splits_by_group(dataset, lambda name: name.split("/")[7])
    assert days == {day: {split_of(day, dataset.config)} for day in days}
    assert len(days) == 7
    assert sum(len(dataset.windows(split)) for split in ("train", "validation", "test")) == 60 * (20 - 4)


def count_groups(dataset: Dataset) -> int:
    return len(np.unique(dataset.split_hash))


def test_identity_without_a_group_raises() -> None:
    names = [*NAMES[:20], "elsewhere/one", "elsewhere/two"]
    with pytest.raises(
        InputError, match=r"split_by: day: .*does not match the identities of 2 of 22 episodes: elsewhere/one, "
    ):
        open_set(names, split_by="day")
    with pytest.raises(InputError, match=r"2 of 22 episodes: elsewhere/one, elsewhere/two.*data\.exclude"):
        open_set(names, split_by=r"LAB(\d?)")
    open_set(names, split_by="day", exclude=("elsewhere/one", "elsewhere/two"))


@pytest.mark.parametrize(
    ("source", "split_by", "num_groups"),
    [("npz", "scene", 3), ("npz", "task", 2), ("lerobot", "task", 2), ("droid_raw", "day", 8), ("rlds", "lab", 2)],
)
def test_each_source_provides_its_labels_for_split_by(
    source: str, split_by: str, num_groups: int, tmp_path: Path
) -> None:
    folder = tmp_path / "set"
    if source == "npz":
        write_npz(
            folder, range(8), scene=lambda number: f"room {number % 3}", language=lambda number: f"task {number % 2}"
        )
    else:
        {"lerobot": write_lerobot, "droid_raw": write_raw, "rlds": write_rlds}[source](folder, range(8))
    dataset = open_dataset(
        config_of(source=source, path=str(folder), split_by=split_by, disk_cache={"dir": str(tmp_path)})
    )
    assert count_groups(dataset) == num_groups


def test_episode_without_a_split_by_value_raises(tmp_path: Path) -> None:
    folder = write_npz(tmp_path / "set", range(4), scene=lambda number: "" if number == 2 else "kitchen")
    with pytest.raises(InputError, match=r"the data set has no value for 1 of 4 episodes: 002"):
        open_dataset(config_of(source="npz", path=str(folder), split_by="scene"))


def test_latent_cache_supports_any_split_by(tmp_path: Path) -> None:
    write_npz(tmp_path / "set", range(8), scene=lambda number: f"room {number % 3}")
    plain = config_of(source="npz", path=str(tmp_path / "set"), disk_cache={"dir": str(tmp_path / "cache")})
    folder = write_cache(open_dataset(plain))
    assert count_groups(open_dataset(plain.with_source("latents", path=str(folder), split_by="scene"))) == 3
