"""Few episodes have all three splits; many are split by the hash alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from memory_source import MemorySource
from vjepa2_ac.config.data import DataConfig, Split
from vjepa2_ac.data.clips import dataset as opening
from vjepa2_ac.data.clips.splits import in_split

SPLITS: tuple[Split, ...] = ("train", "validation", "test")
HASHES = st.lists(st.integers(0, 1023), min_size=1, max_size=40, unique=True)  # in 1/1024


def counts(hashes: list[int], **shares: float) -> dict[str, int]:
    config = DataConfig(path="nowhere", **shares)
    return {split: int(in_split(np.array(hashes, np.uint64), config, split).sum()) for split in SPLITS}


@given(numbers=HASHES, validation=st.floats(0, 0.4), test=st.floats(0, 0.4))
def test_each_episode_is_in_one_split_and_none_that_has_a_share_is_empty(
    numbers: list[int], validation: float, test: float
) -> None:
    found = counts([number * 2**54 for number in numbers], validation_share=validation, test_share=test)
    assert sum(found.values()) == len(numbers)
    if len(numbers) >= 20:
        assert (found["validation"] > 0) == (validation > 0) or found["train"] < 2
        assert found["test"] > 0 or test == 0


@pytest.mark.parametrize("seed", range(20))
def test_twenty_demonstrations_with_the_default_shares_have_all_three(seed: int) -> None:
    hashes = np.random.default_rng(seed).integers(0, 2**64, 20, dtype=np.uint64).tolist()
    found = counts(hashes)
    assert found["validation"] >= 1
    assert found["test"] >= 1
    assert found["train"] >= 10


def test_those_whose_number_comes_next_move_and_nobody_else() -> None:
    hashes = [int(share * 2**64) for share in (0.9, 0.5, 0.3, 0.7)]
    config = DataConfig(path="nowhere", validation_share=0.05, test_share=0.05)
    assert in_split(np.array(hashes, np.uint64), config, "test").tolist() == [False, False, True, False]
    assert in_split(np.array(hashes, np.uint64), config, "validation").tolist() == [False, True, False, False]


def test_a_group_moves_as_a_whole() -> None:
    hashes = [int(share * 2**64) for share in (0.3, 0.3, 0.5, 0.5, 0.9)]
    assert counts(hashes) == {"train": 1, "validation": 2, "test": 2}


def splits_of(monkeypatch: pytest.MonkeyPatch, source: MemorySource, **knobs: object) -> dict[str, Split]:
    """Return the split of every episode that takes part."""
    monkeypatch.setattr(opening, "open_source", lambda _: source)
    values = {"path": "the set", "frames": 3, "stride": 2, "validation_share": 0.02, "test_share": 0.02} | knobs
    dataset = opening.open_dataset(DataConfig.model_validate(values))
    return {
        dataset.table.identity(int(place)): split
        for split in SPLITS
        for place in np.flatnonzero(dataset.members(split))
    }


@pytest.mark.parametrize("split_by", [None, r"episode (\d)"])
@pytest.mark.parametrize("left_out", range(8))
def test_leaving_an_episode_out_moves_no_other(
    monkeypatch: pytest.MonkeyPatch, left_out: int, split_by: str | None
) -> None:
    """Neither `data.exclude` nor an episode that breaks: what a run has trained on stays out of its validation."""
    knobs = {"split_by": split_by, "idle": {"rule": "motion"}, "broken_episodes": "skip"}
    before = splits_of(monkeypatch, MemorySource([60] * 8), **knobs)
    assert set(before.values()) == set(SPLITS)
    without = {name: split for name, split in before.items() if name != f"episode {left_out}"}
    excluded = {"exclude": (f"episode {left_out}",)}
    assert splits_of(monkeypatch, MemorySource([60] * 8), **knobs, **excluded) == without
    monkeypatch.setattr("vjepa2_ac.data.filters.broken_episodes.MOST_BROKEN", 0.2)
    assert (
        splits_of(monkeypatch, MemorySource([61 + left_out] * 8, unreadable=frozenset({left_out})), **knobs) == without
    )


def test_of_the_outcomes_only_the_chosen_one_is_split(monkeypatch: pytest.MonkeyPatch) -> None:
    source = MemorySource([60] * 12, [number % 2 == 0 for number in range(12)])
    found = splits_of(monkeypatch, source, outcome="success")
    assert sorted(found.values()).count("train") == 4
    assert set(found.values()) == set(SPLITS)


def test_one_or_two_episodes_and_shares_of_zero_stay_as_the_hash_says() -> None:
    assert counts([2**63, 2**63 + 2**60]) == {"train": 2, "validation": 0, "test": 0}
    assert counts([2**63] * 9, validation_share=0.0, test_share=0.0) == {"train": 9, "validation": 0, "test": 0}
