"""Selection of episodes: what each filter removed is counted, and opening a large data set is fast."""

import hashlib
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clips import open_memory_source
from memory_source import MemorySource
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data import dataset as dataset_module
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.index import EpisodeProblem, EpisodeTable, StepSelection
from vjepa2_ac.data.selection import BrokenEpisodes
from vjepa2_ac.errors import InputError


def removed(dataset: Dataset) -> dict[str, tuple[int, int, int | None]]:
    return {removal.name: (removal.episodes, removal.steps, removal.windows) for removal in dataset.removed}


def problems(count: int) -> list[EpisodeProblem]:
    return [
        EpisodeProblem(f"bad {number}", f"shard 3: record {number}", "all zeros", "poses", "Look")
        for number in range(count)
    ]


def test_each_filter_reports_the_episodes_it_removed() -> None:
    source = MemorySource([10, 20, 30, 40, 50], [True, False, None, True, False], problems=problems(2))
    dataset = open_memory_source(source, exclude=("episode 4", "bad 1", "bad 0"), outcome="success")
    assert removed(dataset) == {
        "excluded": (3, 50, 46),
        "outcome": (2, 50, 16 + 26),
        "broken": (0, 0, 0),
        "idle": (0, 0, 0),
    }
    assert dataset.windows("train").episodes.tolist() == [0, 3]
    assert len(open_memory_source(source, exclude=("bad 1", "bad 0"), outcome="failure").windows("train")) == 16 + 46


def test_outcome_filter_without_success_labels_raises() -> None:
    with pytest.raises(InputError, match=r"data\.outcome: success: no episode.*Set data\.outcome: all"):
        open_memory_source(MemorySource([10, 10]), outcome="success")
    with pytest.raises(InputError, match=r"none of 2 episodes remains \(removed: outcome 2\)"):
        open_memory_source(MemorySource([10, 10], [False, None]), outcome="success")


def test_broken_episodes_count_across_resume_unless_excluded() -> None:
    def resumed(**options: Any) -> BrokenEpisodes:
        broken = BrokenEpisodes(DataConfig(path="the set", broken_episodes="skip", **options), 300)
        broken.restore({name: f"{name} is damaged" for name in "abc"})
        return broken

    resumed().record("a", "a is damaged")
    with pytest.raises(InputError, match=r"4 of 300 episodes are broken\. The first, a: a is damaged\."):
        resumed().record("d", "d is damaged")
    resumed(exclude=("b",)).record("d", "d is damaged")


def test_excluding_an_unknown_episode_raises() -> None:
    with pytest.raises(InputError, match=r"data\.exclude: unknown episodes: elsewhere\."):
        open_memory_source(MemorySource([10], problems=problems(1)), exclude=("elsewhere", "bad 0"))


def droid_sized() -> EpisodeTable:
    """Return a table with the number of episodes and the identity lengths of DROID 1.0.1."""
    count, generator = 95_658, np.random.default_rng(0)
    names = np.array([f"{number:06d}".encode() * 38 for number in generator.permutation(count)])
    return EpisodeTable(
        num_steps=generator.integers(60, 520, count).astype(np.int32),
        success=np.ones(count, np.int8),
        ids=names,
        id_hash=np.array([int.from_bytes(hashlib.sha256(name).digest()[:8], "big") for name in names], np.uint64),
        id_rank=np.argsort(np.argsort(names)).astype(np.int32),
        motion=np.zeros((count, 8), np.float32),
    )


def select_two_ranges(table: EpisodeTable) -> StepSelection:
    """Return two ranges per episode; a quarter of the steps is idle, as in DROID."""
    count, steps = len(table), table.num_steps
    start, end = (np.zeros(2 * count, np.int32) for _ in range(2))
    start[1::2], end[0::2], end[1::2] = steps * 0.4, steps * 0.3, steps * 0.85
    return StepSelection(np.repeat(np.arange(count, dtype=np.int32), 2), start, end)


@pytest.mark.parametrize("idle", [{}, {"rule": "motion"}])
def test_opening_a_data_set_of_droid_size_makes_no_call_per_episode_and_needs_50_mb(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, idle: dict[str, Any]
) -> None:
    table_file, ranges_file = tmp_path / "table", tmp_path / "ranges"
    table = droid_sized()
    table_file.write_bytes(table.to_bytes())
    ranges_file.write_bytes(select_two_ranges(table).to_bytes())
    monkeypatch.setattr(dataset_module, "find_ranges", lambda *_: StepSelection.from_bytes(ranges_file.read_bytes()))
    del table

    class StoredSource:
        def infos(self, progress: object = None) -> EpisodeTable:
            del progress
            return EpisodeTable.from_bytes(table_file.read_bytes())

        def read(self, *_: object) -> Any: ...

    calls = 0

    def count(*_: object) -> None:
        nonlocal calls
        calls += 1

    tracemalloc.start()
    sys.setprofile(count)
    windows = open_memory_source(StoredSource(), outcome="success", stride=4, frames=16, idle=idle).windows("train")
    sys.setprofile(None)
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(windows) > (8e6 if idle else 15e6)
    assert size < 50e6
    assert calls < 50_000, "fewer than one call per episode"
