"""Splits, windows and clip order depend only on identities, lengths, seed and position."""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clips import open_memory_source
from memory_source import MemorySource
from paths import GOLDEN, ROOT
from vjepa2_ac.config.data import DataConfig, Split
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.data.index import EpisodeTable, StepSelection
from vjepa2_ac.data.selection import draw_split, select_included
from vjepa2_ac.data.windows import (
    ClipOrder,
    Windows,
    find_clip_windows,
    interleave_halves,
    permute_index,
    select_split_windows,
    spread_indices,
)
from vjepa2_ac.episode import EpisodeInfo


def config_of(**options: Any) -> DataConfig:
    return DataConfig(path="nowhere", **({"frames": 4, "stride": 3} | options))


def episodes(*lengths: int) -> list[EpisodeInfo]:
    return [EpisodeInfo(id=f"episode {number}", num_steps=length) for number, length in enumerate(lengths)]


def select_windows(infos: list[EpisodeInfo], config: DataConfig, split: Split) -> Windows:
    """Return the windows of episodes whose steps are all selected."""
    table = EpisodeTable.from_infos(infos)
    is_selected = select_included(table, config)
    starts = find_clip_windows(table, StepSelection.all_steps(table, is_selected), config)
    members = is_selected & draw_split(table.id_hash, config, split)
    return select_split_windows(table, members, starts, config, split)


ALL_TRAIN = {"validation_share": 0.0, "test_share": 0.0}


@settings(max_examples=60)
@given(size=st.integers(1, 300), seed=st.integers(0, 2**31), epoch=st.integers(0, 1000))
def test_permutation_returns_each_index_once(size: int, seed: int, epoch: int) -> None:
    assert sorted(permute_index(index, size=size, seed=seed, epoch=epoch) for index in range(size)) == list(range(size))


def test_clips_start_at_multiples_of_start_every_from_the_first_selected_step() -> None:
    table = EpisodeTable.from_infos([EpisodeInfo("a", 40), EpisodeInfo("b", 20)])
    selected_steps = StepSelection(*(np.array(column, np.int32) for column in ([0, 0, 1], [3, 20, 0], [16, 31, 20])))
    config = config_of(frames=3, stride=2, start_every=4)
    starts = find_clip_windows(table, selected_steps, config)
    windows = [
        (int(starts.episode[run]), step) for run in range(len(starts.first)) for step in starts.steps_of(run).tolist()
    ]
    assert windows == [(0, 3), (0, 7), (0, 11), (0, 23), (1, 0), (1, 4), (1, 8), (1, 12)]


def test_order_and_split_do_not_depend_on_the_order_of_the_episodes() -> None:
    infos = [EpisodeInfo(id=f"episode {number}", num_steps=10 + number % 7) for number in range(60)]
    shuffled = [infos[number] for number in np.random.default_rng(0).permutation(60)]
    config = config_of(validation_share=0.2, test_share=0.2)
    for split in ("train", "validation", "test"):
        windows_by_order = []
        for order in (infos, shuffled):
            clips = ClipOrder(select_windows(order, config, split), seed=1)
            windows_by_order.append([(order[episode].id, start) for episode, start in map(clips.window, range(30))])
        assert windows_by_order[0] == windows_by_order[1]


def test_clips_of_the_demo_equal_the_golden_file() -> None:
    golden = json.loads((GOLDEN / "demo_clip_order.json").read_text())
    infos = [EpisodeInfo(f"{folder}/recordings/MP4--{folder}/trajectory.h5", 41) for folder in golden["folders"]]
    config = load_config(ROOT / "configs/demo.yaml", []).data
    for split, count in golden["windows"].items():
        windows = select_windows(infos, config, split)
        assert len(windows) == count
        if split == "train":
            order = ClipOrder(windows, seed=0)
            assert {position: list(order.window(int(position))) for position in golden["train"]} == golden["train"]
        else:
            assert [list(windows[index]) for index in interleave_halves(spread_indices(count, 40))] == golden[split]


def test_short_episodes_are_skipped_and_reported(caplog: pytest.LogCaptureFixture) -> None:
    windows = select_windows(episodes(9, 10, 3), config_of(**ALL_TRAIN), "train")
    assert windows.short == (0, 2)
    assert windows.episodes.tolist() == [1]
    assert "2 of 3 train episodes are shorter than a clip of 10 control steps" in caplog.text
    assert "episode 2" in caplog.text


@settings(max_examples=50)
@given(size=st.integers(1, 500), count=st.integers(1, 100))
def test_spread_indices_are_distinct_and_even(size: int, count: int) -> None:
    indices = spread_indices(size, count)
    assert len(indices) == len(set(indices)) == min(size, count)
    gaps = np.diff([-size / len(indices) / 2, *indices])
    assert 0 <= min(indices) <= max(indices) < size
    assert abs(gaps - size / len(indices)).max() <= 1


SPLITS: tuple[Split, ...] = ("train", "validation", "test")
HASHES = st.lists(
    st.integers(0, 1023), min_size=1, max_size=40, unique=True
)  # as multiples of 2**54, so that 1024 is the whole range


def count_episodes(hashes: list[int], **shares: float) -> dict[str, int]:
    config = DataConfig(path="nowhere", **shares)
    return {split: int(draw_split(np.array(hashes, np.uint64), config, split).sum()) for split in SPLITS}


@given(numbers=HASHES, validation=st.floats(0, 0.4), test=st.floats(0, 0.4))
def test_each_episode_is_in_one_split_and_no_split_with_a_share_is_empty(
    numbers: list[int], validation: float, test: float
) -> None:
    sizes = count_episodes([number * 2**54 for number in numbers], validation_share=validation, test_share=test)
    assert sum(sizes.values()) == len(numbers)
    if len(numbers) >= 20:
        assert (sizes["validation"] > 0) == (validation > 0) or sizes["train"] < 2
        assert sizes["test"] > 0 or test == 0


def test_larger_held_out_share_only_moves_episodes_out_of_train() -> None:
    hashes = [number * 2**54 for number in range(1024)]
    before, after = (
        {split: draw_split(np.array(hashes, np.uint64), config_of(validation_share=share, test_share=0.05), split)
         for split in SPLITS}
        for share in (0.1, 0.2)
    )  # fmt: skip
    assert [round(before[split].mean(), 2) for split in SPLITS] == [0.85, 0.1, 0.05]
    assert np.array_equal(before["test"], after["test"])
    assert not (before["validation"] & ~after["validation"]).any()


def splits_of(source: MemorySource, **options: object) -> dict[str, Split]:
    """Return the split of each used episode."""
    dataset = open_memory_source(source, **({"validation_share": 0.02, "test_share": 0.02} | options))
    return {
        dataset.table.identity(int(index)): split
        for split in SPLITS
        for index in np.flatnonzero(dataset.split_mask(split))
    }


@pytest.mark.parametrize("split_by", [None, r"episode (\d)"])
@pytest.mark.parametrize("index", [0, 2, 6, 7])
def test_excluding_an_episode_does_not_change_other_splits(index: int, split_by: str | None) -> None:
    """Excluded or broken episodes do not move training episodes into validation."""
    options = {"split_by": split_by, "idle": {"rule": "motion"}, "broken_episodes": "skip"}
    before = splits_of(MemorySource([60] * 8), **options)
    assert set(before.values()) == set(SPLITS)
    remaining = {name: split for name, split in before.items() if name != f"episode {index}"}
    excluded = {"exclude": (f"episode {index}",)}
    assert splits_of(MemorySource([60] * 8), **options, **excluded) == remaining
    assert splits_of(MemorySource([61 + index] * 8, unreadable=frozenset({index})), **options) == remaining


def test_splits_contain_the_selected_outcome_only() -> None:
    source = MemorySource([60] * 12, [number % 2 == 0 for number in range(12)])
    splits = splits_of(source, outcome="success")
    assert sorted(splits.values()).count("train") == 4
    assert set(splits.values()) == set(SPLITS)
