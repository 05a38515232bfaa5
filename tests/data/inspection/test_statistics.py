"""Statistics of a data set: equal to those computed by hand."""

import json
from pathlib import Path

import numpy as np
import pytest

from clips import split_of
from memory_source import MemorySource
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.inspection.statistics import (
    RELEASED_STEP_CM,
    ReadEpisode,
    idle_runs,
    inspect_dataset,
    motion_per_step,
    sample_of,
)
from vjepa2_ac.data.selection import BrokenEpisodes, StepSelection
from vjepa2_ac.errors import InputError
from vjepa2_ac.reports.figures import dataset as figure
from vjepa2_ac.reports.figures.contact_sheet import ContactSheet
from vjepa2_ac.reports.figures.dataset import plot_dataset


def knobs(droid: Path, **changes: object) -> DataConfig:
    values = {"path": str(droid), "frames": 3, "stride": 2, "validation_share": 0.3, "test_share": 0.0}
    return DataConfig.model_validate(values | changes)


def straight_on(steps: int) -> np.ndarray:
    """One centimetre and one degree (about z, past pi) a step."""
    states = np.zeros((steps, 7))
    states[:, 0] = 0.01 * np.arange(steps)
    states[:, 5] = (np.pi - 0.05 + np.deg2rad(np.arange(steps)) + np.pi) % (2 * np.pi) - np.pi
    return states


def test_motion_per_step_is_in_centimetres_and_degrees_at_every_stride() -> None:
    sample = [ReadEpisode(0, straight_on(20), ((0, 20),))]
    for stride in (1, 4, 15):
        found = motion_per_step(sample, stride, control_rate_hz=15.0)
        assert found.seconds == stride / 15
        assert len(found.moved_cm) == 20 - stride
        assert found.percentiles("moved_cm") == pytest.approx([stride] * 4)
        assert found.percentiles("turned_deg") == pytest.approx([stride] * 4)


def test_motion_is_that_within_kept_ranges_only() -> None:
    states = straight_on(20)
    states[10:, 0] += 1.0  # a jump between the ranges
    found = motion_per_step([ReadEpisode(0, states, ((0, 10), (10, 20)))], 4, control_rate_hz=15.0)
    assert len(found.moved_cm) == 12
    assert found.moved_cm.max() == pytest.approx(4)


def test_a_stride_that_fits_nowhere_has_no_percentiles() -> None:
    assert motion_per_step([ReadEpisode(0, straight_on(5), ((0, 5),))], 5, 15.0).percentiles("moved_cm") == []


def test_standing_still_counts_from_a_run_that_is_long_enough() -> None:
    states = straight_on(30)
    states[5:10] = states[5]  # steps 6 to 9 are idle: too short a run
    states[15:25] = states[15]
    assert np.flatnonzero(idle_runs(states, DataConfig(path="x"))).tolist() == list(range(16, 25))


def test_figures_of_a_whole_set(droid: Path) -> None:
    dataset = open_dataset(knobs(droid))
    found = inspect_dataset(dataset)
    assert found.length_percentiles == [12, 12, 14, 16, 17]
    assert found.hours == pytest.approx(87 / 15 / 3600)
    assert found.success_share == pytest.approx(4 / 6)
    assert len(found.sample) == 6
    assert [one.stride for one in found.motions] == [4, 8, 15]
    splits = [split_of(info.id, dataset.config) for info in dataset.table]
    assert found.episodes_of == {name: splits.count(name) for name in ("train", "validation", "test")}
    assert found.windows_of["train"] + found.windows_of["validation"] == 87 - 6 * 4
    assert found.windows_of["test"] == 0
    by_hand = np.concatenate([dataset.source.read(index).states for index in range(6)])
    assert found.range_of(6) == (pytest.approx(by_hand[:, 6].min()), pytest.approx(by_hand[:, 6].max()))


def test_a_sample_is_drawn_from_those_that_take_part_and_is_always_the_same(droid: Path) -> None:
    dataset = open_dataset(knobs(droid, outcome="failure"))
    assert sorted(sample_of(dataset, 10)) == np.flatnonzero(dataset.table.success == 0).tolist()
    assert sample_of(dataset, 1) == sample_of(dataset, 1)
    assert len(inspect_dataset(dataset, episodes=1).sample) == 1


def in_memory(broken: frozenset[int], policy: str, pictureless: frozenset[int] = frozenset()) -> Dataset:
    config = DataConfig.model_validate({"path": "memory", "broken_episodes": policy, "frames": 3})
    source = MemorySource([60] * 100, unreadable=broken, pictureless=pictureless)
    table = source.infos()
    return Dataset(config, source, table, StepSelection.whole(table, np.ones(100, bool)), BrokenEpisodes(config, 100))


def test_an_episode_of_the_sample_that_cannot_be_read_is_counted_and_named(caplog: pytest.LogCaptureFixture) -> None:
    dataset = in_memory(frozenset({7}), "skip")
    assert len(inspect_dataset(dataset).sample) == 99
    assert list(dataset.broken.reasons) == ["episode 7"]
    assert "memory: episode 7: damaged" in caplog.text
    with pytest.raises(InputError, match="2 of 100 episodes are broken"):
        inspect_dataset(in_memory(frozenset({7, 8}), "skip"))
    with pytest.raises(InputError, match=r"memory: episode 7: damaged\..*add to data\.exclude: \[\"episode 7\"\]"):
        inspect_dataset(in_memory(frozenset({7}), "error"))


def test_a_broken_frame_is_left_out_of_the_contact_sheet(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sheets: list[ContactSheet] = []
    monkeypatch.setattr(figure, "plot_contact_sheet", lambda sheet, path: sheets.append(sheet) or path)
    dataset = in_memory(frozenset(), "skip", frozenset({7}))
    plot_dataset(dataset, inspect_dataset(dataset), tmp_path / "sheet.png", rows=100)
    assert len(sheets[0].strips) == 99
    assert list(dataset.broken.reasons) == ["episode 7"]
    dataset = in_memory(frozenset(), "error", frozenset({7}))
    with pytest.raises(InputError, match=r"pictures of episode 7: damaged\..*add to data\.exclude"):
        plot_dataset(dataset, inspect_dataset(dataset), tmp_path / "sheet.png", rows=100)


def test_the_figures_are_plain_values_and_stand_beside_what_is_known_of_the_released_weights(droid: Path) -> None:
    found = inspect_dataset(open_dataset(knobs(droid)))
    read = json.loads(json.dumps(found.as_dict()))
    assert read["episodes"] == 6
    assert [row["stride"] for row in read["per_model_step"]] == [4, 8, 15]
    assert "unsettled" in read["released_weights"]
    assert str(RELEASED_STEP_CM) in read["released_weights"]


def test_the_example_of_upstream_moves_as_far_as_is_said(shared: Path) -> None:
    with np.load(shared / "data" / "franka_example_traj.npz") as file:
        states = np.squeeze(file["states"])
    assert np.linalg.norm(states[1, :3] - states[0, :3]) * 100 == pytest.approx(RELEASED_STEP_CM, abs=0.05)
