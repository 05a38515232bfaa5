"""All sources: a source is opened once, may read from another source, and refuses unusable identities."""

import pickle
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.sources import NpzData
from vjepa2_ac.data.index import EpisodeTable
from vjepa2_ac.data.sources.indexed_source import IndexedSource, IndexEntry, build_table
from vjepa2_ac.data.sources.npz import NpzSource
from vjepa2_ac.episode import Episode, EpisodeInfo, Progress, StepRanges
from vjepa2_ac.errors import InputError

T = TypeVar("T")


def write_npz(folder: Path, episodes: int) -> NpzData:
    folder.mkdir()
    for number in range(episodes):
        states = np.tile(np.arange(30)[:, None] * 0.01 + number * 0.001, 7)
        frames = np.full((30, 8, 8, 3), number, np.uint8)
        np.savez(folder / f"{number}.npz", states=states, frames=frames, fps_hz=4.0)
    return NpzData(path=str(folder), disk_cache={"dir": str(folder / "cache")})


# ---- opening ----


class EveryOther(IndexedSource[DataConfig, NpzSource]):
    """Every other episode of another source."""

    times_opened = 0

    def _open_data_set(self, progress: Progress) -> tuple[EpisodeTable, NpzSource]:
        type(self).times_opened += 1
        inner = NpzSource(self._config)
        return EpisodeTable.from_infos(list(inner.infos(progress))[::2]), inner

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        return self._open()[1].read(2 * index, camera, needed)


def run_together(*tasks: Callable[[], T]) -> list[T]:
    """Return the results of tasks that run in separate threads; fail if a result is missing after 20 s."""
    results: list[T] = []
    threads = [threading.Thread(target=lambda task=task: results.append(task()), daemon=True) for task in tasks]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert len(results) == len(tasks), "a task still waits for a lock"
    return results


def test_nested_source_opens_and_is_pickled_with_its_index(tmp_path: Path) -> None:
    source = EveryOther(write_npz(tmp_path / "set", 5))
    [table] = run_together(source.infos)
    assert [info.id for info in table] == ["0", "2", "4"]
    assert source.read(1).read_frames([3]).max() == 2
    EveryOther.times_opened = 0
    copy = pickle.loads(pickle.dumps(source))  # noqa: S301 - our own bytes
    assert [info.id for info in run_together(copy.infos)[0]] == ["0", "2", "4"]
    assert copy.read(2).read_frames([0]).max() == 4
    assert EveryOther.times_opened == 0, "the index is pickled"


# ---- identities ----


@pytest.mark.parametrize("identity", ["a\0", "\0", "a\0b"])
def test_identity_with_nul_character_is_a_problem_of_that_episode(identity: str, tmp_path: Path) -> None:
    entries = [IndexEntry(EpisodeInfo(name, 30), f"file {name!r}") for name in ("a", identity, "é")]
    table = build_table(entries, DataConfig(path=str(tmp_path)), 3)
    assert [info.id for info in table] == ["a", "é"]
    [problem] = table.problems
    assert problem.name == identity
    assert re.search(r"^file .*: a NUL character in the identity '.*\\x00", str(problem.error))
    assert EpisodeTable.from_bytes(table.to_bytes()).problems == table.problems
    with pytest.raises(InputError, match=r"episode .*: a NUL character in the identity"):
        EpisodeTable.from_infos([EpisodeInfo("a", 30), EpisodeInfo(identity, 30)])
