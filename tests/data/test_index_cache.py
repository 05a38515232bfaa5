"""The index cache: a data set is scanned once, and a damaged cache is not used."""

import errno
import logging
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vjepa2_ac import storage
from vjepa2_ac.config import DiskCacheConfig
from vjepa2_ac.data.index import (
    EpisodeProblem,
    EpisodeTable,
    build_labels,
    compute_fingerprint,
    get_or_build_index,
    index_key,
)
from vjepa2_ac.episode import EpisodeInfo

TABLE = replace(
    EpisodeTable.from_infos([EpisodeInfo(f"küche/{number}", 10 + number) for number in range(5)]),
    problems=(EpisodeProblem("bad", "here", "damaged"),),
    locators={"offset": np.arange(5)},
    labels=build_labels([{"task": task} for task in (None, "lift", "push", "", "lift")]),
)


KEY = index_key({"files": 3}, "/data/set")


def ids(table: EpisodeTable) -> list[str]:
    return [info.id for info in table]


def cached_table(
    tmp_path: Path, key: str = KEY, path: str = "/data/set", table: EpisodeTable | None = None
) -> EpisodeTable:
    """Return the cached table, built from `table`; without `table` it must be in the cache."""
    return get_or_build_index(
        DiskCacheConfig(dir=str(tmp_path)), key, path, lambda: table or pytest.fail("built again")
    )


def test_table_is_built_once_and_rebuilt_after_deletion(tmp_path: Path) -> None:
    for table in (TABLE, None):
        cached = cached_table(tmp_path, table=table)
        assert (ids(cached), cached.problems, compute_fingerprint(cached)) == (ids(TABLE), TABLE.problems, KEY)
        assert cached.labels["task"].name_at(2) == "push"
        assert np.array_equal(cached.id_rank, TABLE.id_rank)
    (tmp_path / f"index/{KEY}.index").unlink()
    assert ids(cached_table(tmp_path, table=EpisodeTable.from_infos([EpisodeInfo("other", 1)]))) == ["other"]


def test_index_of_a_moved_folder_is_reused_with_updated_paths(tmp_path: Path) -> None:
    problem = EpisodeProblem("bad", "/data/set/a.npz: x", "damaged")
    broken = replace(EpisodeTable.from_infos([EpisodeInfo("one", 3)]), problems=(problem,))
    cached_table(tmp_path, table=broken)
    table = cached_table(tmp_path, index_key({"files": 3}, "/mnt/set"), "/mnt/set")
    assert [problem.where for problem in table.problems] == ["/mnt/set/a.npz: x"]
    other_keys = [index_key({"files": 4}, "/data/set"), index_key({"files": 3}, "/data/set", identity="other/success")]
    other_keys += [
        index_key({"files": 3}, f"gs://{bucket}/set") for bucket in "ab"
    ]  # the versions of remote files are less reliable
    assert len({KEY, *other_keys}) == 5


def test_damaged_index_is_rebuilt(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    generator, num_rebuilt = random.Random(0), 0  # noqa: S311 - no secret
    table_bytes = cached_table(tmp_path, table=TABLE).to_bytes()
    [path] = (tmp_path / "index").iterdir()
    content = path.read_bytes()
    with caplog.at_level(logging.CRITICAL):
        for _ in range(300):
            damaged = bytearray(content)
            damaged[generator.randrange(len(damaged))] ^= 1 << generator.randrange(8)
            path.write_bytes(damaged[: len(damaged) if generator.random() < 0.9 else generator.randrange(len(damaged))])
            assert cached_table(tmp_path, table=TABLE).to_bytes() == table_bytes
            num_rebuilt += path.read_bytes() == content
            path.write_bytes(content)
    assert num_rebuilt > 150


def test_index_of_another_key_is_not_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cached_table(tmp_path, table=TABLE)
    [path] = (tmp_path / "index").iterdir()
    other_key = index_key({"files": 4}, "/data/set")
    path.rename(path.with_name(f"{other_key}.index"))
    assert ids(cached_table(tmp_path, other_key, table=EpisodeTable.from_infos([EpisodeInfo("other", 1)]))) == ["other"]
    assert "for other data" in caplog.text
    assert ids(cached_table(tmp_path, other_key)) == ["other"]


def test_unwritable_cache_folder_logs_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(storage, "write_atomically", refuse)
    assert len(cached_table(tmp_path, table=TABLE)) == 5
    assert "No space left on device" in caplog.text
