"""Splits, windows and order: pure functions of identities, lengths, seed and position."""

import itertools
import json
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clips import split_of
from paths import GOLDEN, ROOT
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.data.clips.permutation import permuted
from vjepa2_ac.data.clips.splits import in_split
from vjepa2_ac.data.clips.windows import ClipOrder, Windows, far_neighbours, spread
from vjepa2_ac.data.clips.windows import windows_of as windows_of_starts
from vjepa2_ac.data.filters.exclusion import included
from vjepa2_ac.data.filters.step_ranges import StepSelection, clip_starts
from vjepa2_ac.data.index import EpisodeTable
from vjepa2_ac.episode import EpisodeInfo
from vjepa2_ac.errors import InputError


def settings_of(**knobs: Any) -> DataConfig:
    return DataConfig(path="nowhere", **({"frames": 4, "stride": 3} | knobs))


def episodes(*lengths: int) -> list[EpisodeInfo]:
    return [EpisodeInfo(id=f"episode {number}", num_steps=length) for number, length in enumerate(lengths)]


def windows_of(infos: list[EpisodeInfo], config: DataConfig, split: Split) -> Windows:
    """Return the windows of episodes of which every step is kept."""
    table = EpisodeTable.of(infos)
    taking_part = included(table, config)
    starts = clip_starts(table, StepSelection.whole(table, taking_part), config)
    return windows_of_starts(table, taking_part, starts, config, split, table.id_hash)


ALL_TRAIN = {"validation_share": 0.0, "test_share": 0.0}


@settings(max_examples=60)
@given(size=st.integers(1, 300), seed=st.integers(0, 2**31), epoch=st.integers(0, 1000))
def test_a_permutation_hits_every_index_once(size: int, seed: int, epoch: int) -> None:
    assert sorted(permuted(index, size=size, seed=seed, epoch=epoch) for index in range(size)) == list(range(size))


def test_a_large_permutation_stays_in_range_without_repeating() -> None:
    size = 27_600_000  # windows of DROID
    seen = {permuted(index, size=size, seed=0, epoch=0) for index in range(2_000)}
    assert len(seen) == 2_000
    assert 0 <= min(seen) < size / 100
    assert size * 0.99 < max(seen) < size


def test_seeds_and_epochs_have_orders_of_their_own() -> None:
    orders = {
        tuple(permuted(index, size=20, seed=seed, epoch=epoch) for index in range(20))
        for seed in range(5)
        for epoch in range(5)
    }
    assert len(orders) == 25


@pytest.mark.parametrize("size", [5, 16])
def test_every_place_is_equally_likely_for_every_index(size: int) -> None:
    epochs = 600
    counts = np.zeros((size, size))
    for epoch in range(epochs):
        for index in range(size):
            counts[index, permuted(index, size=size, seed=1, epoch=epoch)] += 1
    expected = epochs / size
    deviation = (counts - expected) / np.sqrt(expected * (1 - 1 / size))
    assert abs(deviation).max() < 5
    assert deviation.std() < 1.25


def test_neighbours_do_not_stay_together() -> None:
    places = np.array([permuted(index, size=4_000, seed=0, epoch=0) for index in range(4_000)])
    assert abs(np.corrcoef(places[:-1], places[1:])[0, 1]) < 0.05
    assert abs(np.corrcoef(np.arange(4_000), places)[0, 1]) < 0.05


def test_an_epoch_sees_every_window_once() -> None:
    windows = windows_of(episodes(10, 25, 12, 13), settings_of(**ALL_TRAIN), "train")
    order = ClipOrder(windows, seed=3)
    everything = sorted(
        (episode, start) for episode, length in enumerate((10, 25, 12, 13)) for start in range(length - 9)
    )
    first, second = ([order.window(epoch * len(windows) + index) for index in range(len(windows))] for epoch in (0, 1))
    assert sorted(first) == sorted(second) == everything
    assert first != second


def test_a_clip_fits_into_its_episode_to_the_last_step() -> None:
    config = settings_of(**ALL_TRAIN)
    infos = episodes(10, 31)
    windows = windows_of(infos, config, "train")
    ends = {
        (episode, start + (config.frames - 1) * config.stride)
        for episode, start in map(windows.__getitem__, range(len(windows)))
    }
    assert max(end for episode, end in ends if episode == 0) == 9
    assert max(end for episode, end in ends if episode == 1) == 30
    assert len(windows) == 1 + 22


def test_a_window_beyond_the_last_is_refused() -> None:
    windows = windows_of(episodes(10), settings_of(**ALL_TRAIN), "train")
    for index in (-1, 1):
        with pytest.raises(IndexError):
            windows[index]
    with pytest.raises(ValueError, match="index 5 of 5"):
        permuted(5, size=5, seed=0, epoch=0)


def test_order_and_split_do_not_depend_on_the_order_of_the_episodes() -> None:
    infos = [EpisodeInfo(id=f"episode {number}", num_steps=10 + number % 7) for number in range(60)]
    shuffled = [infos[number] for number in np.random.default_rng(0).permutation(60)]
    config = settings_of(validation_share=0.2, test_share=0.2)
    for split in ("train", "validation", "test"):
        named = []
        for order in (infos, shuffled):
            clips = ClipOrder(windows_of(order, config, split), seed=1)
            named.append([(order[episode].id, start) for episode, start in map(clips.window, range(30))])
        assert named[0] == named[1]


def test_splits_share_no_episode_and_leave_none_out() -> None:
    infos = episodes(*[20] * 200)
    config = settings_of(validation_share=0.3, test_share=0.2)
    members = [set(windows_of(infos, config, split).episodes.tolist()) for split in ("train", "validation", "test")]
    assert sum(len(split) for split in members) == 200
    assert len(set.union(*members)) == 200


def test_shares_are_kept_and_growing_one_moves_few_episodes() -> None:
    names = [f"lab/{number}" for number in range(4_000)]
    counts = Counter(split_of(name, settings_of(validation_share=0.1, test_share=0.05)) for name in names)
    assert abs(counts["validation"] / 4_000 - 0.10) < 0.02
    assert abs(counts["test"] / 4_000 - 0.05) < 0.015
    for name in names[:500]:
        before = split_of(name, settings_of(validation_share=0.1, test_share=0.05))
        after = split_of(name, settings_of(validation_share=0.2, test_share=0.05))
        assert before == after or (before, after) == ("train", "validation")


def test_all_episodes_are_split_at_once_as_each_alone() -> None:
    infos = episodes(*[20] * 300)
    config = settings_of(validation_share=0.23, test_share=0.31)
    for split in ("train", "validation", "test"):
        expected = [split_of(info.id, config) == split for info in infos]
        assert in_split(EpisodeTable.of(infos).id_hash, np.ones(300, bool), config, split).tolist() == expected


def test_the_split_never_changes_between_versions() -> None:
    config = settings_of(validation_share=0.3, test_share=0.3)
    assert [split_of(f"episode {number}", config) for number in range(8)] == [
        "validation",
        "train",
        "test",
        "train",
        "train",
        "train",
        "validation",
        "train",
    ]


def test_the_order_never_changes_between_versions() -> None:
    assert [permuted(index, size=11, seed=7, epoch=2) for index in range(11)] == [7, 9, 1, 10, 3, 6, 8, 2, 0, 5, 4]


def test_the_demo_sees_the_clips_it_always_saw() -> None:
    golden = json.loads((GOLDEN / "demo_clip_order.json").read_text())
    infos = [EpisodeInfo(f"{folder}/recordings/MP4--{folder}/trajectory.h5", 41) for folder in golden["folders"]]
    config = load_config(ROOT / "configs/demo.yaml", []).data
    for split, count in golden["windows"].items():
        windows = windows_of(infos, config, split)
        assert len(windows) == count
        if split == "train":
            order = ClipOrder(windows, seed=0)
            assert {place: list(order.window(int(place))) for place in golden["train"]} == golden["train"]
        else:
            assert [list(windows[index]) for index in far_neighbours(spread(count, 40))] == golden[split]


def test_short_episodes_are_left_out_counted_and_named(caplog: pytest.LogCaptureFixture) -> None:
    windows = windows_of(episodes(9, 10, 3), settings_of(**ALL_TRAIN), "train")
    assert windows.short.tolist() == [0, 2]
    assert windows.episodes.tolist() == [1]
    assert "2 of 3 train episodes are shorter than a clip of 10 control steps" in caplog.text
    assert "episode 2" in caplog.text


def test_short_episodes_are_spoken_of_once_for_each_set_of_data(caplog: pytest.LogCaptureFixture) -> None:
    for path in ("this set", "this set", "another set"):
        windows_of(episodes(9, 10), settings_of(**ALL_TRAIN).model_copy(update={"path": path}), "train")
    assert [record.getMessage().split(":")[0] for record in caplog.records] == ["this set", "another set"]


def test_short_episodes_stop_the_run_when_told_to() -> None:
    config = settings_of(short_episodes="error", **ALL_TRAIN)
    with pytest.raises(InputError, match=r"2 of 3 train episodes.*episode 0, has 9 steps.*needed: 10 steps.*skip"):
        windows_of(episodes(9, 10, 3), config, "train")


def test_short_episodes_that_stop_the_run_are_named_ten_at_most() -> None:
    config = settings_of(short_episodes="error", **ALL_TRAIN)
    with pytest.raises(InputError, match=r"Too short: episode 1, episode 2\."):
        windows_of(episodes(10, 3, 3), config, "train")
    with pytest.raises(InputError, match=r"Too short: episode 0, (episode \d+, ){8}episode \d+ and 2 more\."):
        windows_of(episodes(*[3] * 12, 10), config, "train")


def test_an_excluded_episode_is_in_no_split_and_the_others_stay_where_they_were() -> None:
    infos = episodes(*[20] * 60)
    shares = {"validation_share": 0.3, "test_share": 0.2}
    without = settings_of(exclude=("episode 7", "episode 11", "episode 0"), **shares)
    for split in ("train", "validation", "test"):
        everyone, fewer = (set(windows_of(infos, c, split).episodes.tolist()) for c in (settings_of(**shares), without))
        assert fewer == everyone - {7, 11, 0}


def test_an_excluded_episode_may_be_short() -> None:
    config = settings_of(short_episodes="error", exclude=("episode 1",), **ALL_TRAIN)
    assert windows_of(episodes(10, 0), config, "train").episodes.tolist() == [0]


def test_excluding_an_episode_that_there_is_not_is_refused() -> None:
    config = settings_of(exclude=("episode 1", "episode 9", "elsewhere"), **ALL_TRAIN)
    with pytest.raises(
        InputError, match=r"data\.exclude: not the identity.*: elsewhere, episode 9\. .*such as episode 0"
    ):
        windows_of(episodes(10, 10), config, "train")


def test_nothing_but_short_episodes_stops_the_run() -> None:
    with pytest.raises(InputError, match=r"2 of 2 train episodes.*Lower data\.frames or data\.stride\.$"):
        windows_of(episodes(9, 3), settings_of(**ALL_TRAIN), "train")


def test_an_empty_split_says_which_share_to_raise() -> None:
    with pytest.raises(InputError, match=r"no validation episodes among 3 .*Raise data\.validation_share"):
        windows_of(episodes(20, 20, 20), settings_of(**ALL_TRAIN), "validation")
    with pytest.raises(InputError, match=r"no train episodes among 0"):
        windows_of([], settings_of(**ALL_TRAIN), "train")


def test_a_range_of_kept_steps_costs_a_few_bytes() -> None:
    windows = windows_of(episodes(*[300] * 1000), settings_of(**ALL_TRAIN), "train")
    assert sum(column.nbytes for column in (*windows.starts.columns, windows.ends)) == 24_000


@settings(max_examples=50)
@given(size=st.integers(1, 500), count=st.integers(1, 100))
def test_what_is_spread_is_distinct_and_even(size: int, count: int) -> None:
    chosen = spread(size, count)
    assert len(chosen) == len(set(chosen)) == min(size, count)
    gaps = np.diff([-size / len(chosen) / 2, *chosen])
    assert 0 <= min(chosen) <= max(chosen) < size
    assert abs(gaps - size / len(chosen)).max() <= 1


@pytest.mark.parametrize("count", [1, 2, 3, 8, 31])
def test_far_neighbours_are_all_there_and_lie_half_the_list_apart(count: int) -> None:
    order = far_neighbours(list(range(count)))
    assert sorted(order) == list(range(count))
    for one, other in itertools.pairwise(order):
        assert abs(one - other) >= count // 2 - 1
