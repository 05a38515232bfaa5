"""The statistics of a data set equal values computed by hand."""

from pathlib import Path

import numpy as np
import pytest

from clips import dataset_in_memory, split_of
from memory_source import MemorySource
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.errors import InputError
from vjepa2_ac.inspection.statistics import MOVED, TURNED, find_idle_steps, inspect_dataset


def make_data_config(droid: Path, **changes: object) -> DataConfig:
    values = {"path": str(droid), "frames": 3, "stride": 2, "validation_share": 0.3, "test_share": 0.0}
    return DataConfig.model_validate(values | changes)


def steady_motion(steps: int) -> np.ndarray:
    """Return poses that move by 1 cm and rotate by 1 degree about z, past pi, in each step."""
    states = np.zeros((steps, 7))
    states[:, 0] = 0.01 * np.arange(steps)
    states[:, 5] = (np.pi - 0.05 + np.deg2rad(np.arange(steps)) + np.pi) % (2 * np.pi) - np.pi
    return states


def test_motion_per_step_is_in_centimetres_and_degrees_at_every_stride(monkeypatch: pytest.MonkeyPatch) -> None:
    source = MemorySource([40], states=lambda _: steady_motion(40))
    monkeypatch.setattr("vjepa2_ac.inspection.statistics.candidate_strides", lambda _: (1, 4, 15, 40))
    dataset = dataset_in_memory(source)
    inspection = inspect_dataset(dataset)
    *measured, too_large = inspection.values["per_model_step"]
    for statistics, stride in zip(measured, (1, 4, 15), strict=True):
        assert (statistics["stride"], statistics["seconds"]) == (stride, stride / 15)
        assert len(inspection.steps[stride][MOVED]) == 40 - stride
        assert statistics[MOVED] == pytest.approx([stride] * 4)
        assert statistics[TURNED] == pytest.approx([stride] * 4)
    assert too_large == {"stride": 40, "seconds": 40 / 15, MOVED: [], TURNED: []}


def test_only_long_enough_idle_runs_count_as_idle() -> None:
    states = steady_motion(30)
    states[5:10] = states[5]  # steps 6 to 9 are idle, which is too short
    states[15:25] = states[15]
    assert np.flatnonzero(find_idle_steps(states, DataConfig(path="x"))).tolist() == list(range(16, 25))


def test_statistics_of_a_data_set_equal_values_computed_by_hand(droid: Path) -> None:
    dataset = open_dataset(make_data_config(droid))
    inspection = inspect_dataset(dataset)
    values = inspection.values
    assert values["length_percentiles_0_10_50_90_100"] == [12, 12, 14, 16, 17]
    assert values["hours"] == pytest.approx(87 / 15 / 3600)
    assert values["success_share"] == pytest.approx(4 / 6)
    assert len(inspection.sample) == 6
    assert list(inspection.steps) == [4, 8, 15]
    splits = [split_of(info.id, dataset.config) for info in dataset.table]
    assert {name: counts["episodes"] for name, counts in values["splits"].items()} == {
        name: splits.count(name) for name in ("train", "validation", "test")
    }
    assert [values["splits"][name]["windows"] for name in ("train", "validation", "test")] == [
        *(len(dataset.windows(split)) for split in ("train", "validation")), 0,
    ]  # fmt: skip
    expected_states = np.concatenate([dataset.source.read(index).states for index in range(6)])
    assert inspection.ranges[6].tolist() == pytest.approx([expected_states[:, 6].min(), expected_states[:, 6].max()])


def hundred_episodes(broken: frozenset[int], policy: str) -> Dataset:
    return dataset_in_memory(MemorySource([60] * 100, unreadable=broken), broken_episodes=policy)


def test_unreadable_episode_of_the_sample_is_skipped_or_an_error_by_config(caplog: pytest.LogCaptureFixture) -> None:
    dataset = hundred_episodes(frozenset({7}), "skip")
    assert len(inspect_dataset(dataset).sample) == 99
    assert list(dataset.broken.reasons) == ["episode 7"]
    assert "memory: episode 7: damaged" in caplog.text
    with pytest.raises(InputError, match="4 of 100 episodes are broken"):
        inspect_dataset(hundred_episodes(frozenset({7, 8, 9, 10}), "skip"))
    with pytest.raises(InputError, match=r"memory: episode 7: damaged\..*add to data\.exclude: \[\"episode 7\"\]"):
        inspect_dataset(hundred_episodes(frozenset({7}), "error"))
