"""Duplicated episodes are found in every data format, and reported by `data check` and `data inspect`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clips import dataset_in_memory
from copied_sets import STEPS, WRITERS, write_lerobot, write_npz
from gcs import Gcs
from memory_source import MemorySource
from synthetic import synthetic_states
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.index import UNKNOWN
from vjepa2_ac.inspection.check import check_data
from vjepa2_ac.inspection.findings import Duplicates, find_duplicates
from vjepa2_ac.inspection.statistics import inspect_dataset

RECORDINGS = (0, 1, 2, 3, 0, 4, 5, 0, 6, 4)  # the first one three times, the fifth one twice


def config_of(source: str, path: object, tmp_path: Path, **changes: object) -> DataConfig:
    values = {
        "source": source, "path": str(path), "frames": 3, "stride": 2, "workers": 0, "validation_share": 0.4,
        "test_share": 0.2, "disk_cache": {"dir": str(tmp_path / "cache")},
    }  # fmt: skip
    return DataConfig.model_validate(values | changes)


def in_memory(hashes: list[int]) -> Dataset:
    dataset = dataset_in_memory(MemorySource([20] * len(hashes)), validation_share=0.3, test_share=0.2)
    return replace(dataset, table=replace(dataset.table, state_hash=np.array(hashes, np.uint64)))


@pytest.mark.parametrize("source", WRITERS)
def test_copies_are_found_in_every_data_format_and_from_the_cached_index(source: str, tmp_path: Path) -> None:
    config = config_of(source, WRITERS[source](tmp_path / "set", RECORDINGS), tmp_path)
    for _ in range(2):
        dataset = open_dataset(config)
        duplicates = find_duplicates(dataset)
        assert (duplicates.is_known, duplicates.episodes, duplicates.different) == (True, 5, 2)
        assert len(duplicates.copies) == 3
        first, second = (dataset.table.find(name) for name, _ in duplicates.example)
        assert first != second
        np.testing.assert_array_equal(*(dataset.source.read(index).states for index in (first, second)))  # type: ignore[arg-type]


def test_duplicates_of_a_remote_data_set_without_states_are_skipped(gcs: Gcs, tmp_path: Path) -> None:
    gcs.upload(write_lerobot(tmp_path / "set", RECORDINGS), "bucket/set")
    config = config_of("lerobot", "gs://bucket/set", tmp_path)
    duplicates = find_duplicates(open_dataset(config))
    assert duplicates == Duplicates(is_known=False)
    assert {finding.about: finding.level for finding in check_data(config, clips=2)}["duplicates"] == "skipped"
    assert str(duplicates) == "needs the states of the episodes in the index, found none"


def test_copies_across_splits_are_counted_with_an_example() -> None:
    pairs = in_memory([1 + number // 2 for number in range(40)])
    duplicates = find_duplicates(pairs)
    splits = {name: split for split in ("train", "validation", "test") for name in names_in(pairs, split)}
    across = sum(2 for number in range(0, 40, 2) if splits[f"episode {number}"] != splits[f"episode {number + 1}"])
    assert (duplicates.episodes, duplicates.different, duplicates.across, len(duplicates.copies)) == (
        40,
        20,
        across,
        20,
    )
    (first, first_split), (second, second_split) = duplicates.example
    assert (splits[first], splits[second]) == (first_split, second_split)
    assert first_split != second_split
    assert int(first.split()[1]) // 2 == int(second.split()[1]) // 2
    assert f"{across} of them have a copy in another split, such as {first} ({first_split})" in str(duplicates)
    assert "data.exclude" in str(duplicates)
    assert "data.split_by" in str(duplicates)


def names_in(dataset: Dataset, split: str) -> list[str]:
    return [dataset.table.identity(int(index)) for index in dataset.windows(split).episodes]  # type: ignore[arg-type]


def test_different_and_unhashed_episodes_are_no_duplicates() -> None:
    assert find_duplicates(in_memory([1, 2, 3, UNKNOWN, UNKNOWN])) == Duplicates(is_known=True)


def test_copies_with_noise_or_rounding_are_found_and_similar_episodes_are_not(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)

    def near(number: int) -> list[np.ndarray]:
        states = synthetic_states(STEPS, seed=number)
        return [states, states + generator.normal(0, 1e-6, states.shape), np.round(states, 4), states + 2e-3]

    folder = tmp_path / "set"
    folder.mkdir()
    frames = np.random.default_rng(0).integers(0, 255, (STEPS, 8, 8, 3)).astype(np.uint8)
    static = np.tile([0.4, 0, 0.4, 3, 0, 0, 0], (STEPS, 1)) + generator.normal(0, 1e-6, (3, STEPS, 7))
    states = {f"{number}{variant}": poses for number in range(3) for variant, poses in enumerate(near(number))}
    for name, poses in (states | {f"still {number}": poses for number, poses in enumerate(static)}).items():
        np.savez(folder / f"{name}.npz", states=poses, frames=frames, fps_hz=15.0)
    duplicates = find_duplicates(open_dataset(config_of("npz", folder, tmp_path)))
    assert (duplicates.episodes, duplicates.different, duplicates.copies) == (
        9,
        3,
        ("01", "02", "11", "12", "21", "22"),
    )


def test_check_and_inspect_warn_only_if_there_are_copies(tmp_path: Path) -> None:
    copied = config_of("npz", write_npz(tmp_path / "copied", RECORDINGS), tmp_path)
    finding = next(entry for entry in check_data(copied, clips=2) if entry.about == "duplicates")
    assert (finding.level, "5 episodes have the states" in finding.text) == ("warning", True)
    inspection = inspect_dataset(open_dataset(copied))
    assert "inspect.json" in inspection.summary["duplicates"]
    assert sorted(inspection.values["duplicates"]["copies"]) == ["004", "007", "009"]
    single = config_of("npz", write_npz(tmp_path / "single", range(10)), tmp_path)
    finding = next(entry for entry in check_data(single, clips=2) if entry.about == "duplicates")
    assert (finding.level, finding.text) == ("ok", "no two episodes have the same states")
