"""The index cache: a data set is scanned once, and a damaged cache is not used."""

import errno
import logging
import os
import random
import threading
from pathlib import Path

import numpy as np
import pytest

from vjepa2_ac import storage
from vjepa2_ac.config import DiskCacheConfig
from vjepa2_ac.data.index.episode_table import EpisodeProblem, EpisodeTable
from vjepa2_ac.data.index.index_cache import IndexKeys, cache_folder, fingerprints_of, get_or_build, record_usage
from vjepa2_ac.episode import EpisodeInfo

TABLE = EpisodeTable.of(
    [EpisodeInfo(f"küche/{number}", 10 + number) for number in range(5)],
    problems=[EpisodeProblem("bad", "here", "damaged")],
    locators={"offset": np.arange(5)},
)


KEYS = IndexKeys.of({"files": 3}, "/data/set")


def ids(table: EpisodeTable) -> list[str]:
    return [info.id for info in table]


def test_a_table_is_built_once(tmp_path: Path) -> None:
    config, built = DiskCacheConfig(dir=str(tmp_path)), []
    for _ in range(2):
        table = get_or_build(config, KEYS, "/data/set", lambda: built.append(1) or TABLE)
        assert (ids(table), table.problems) == (ids(TABLE), TABLE.problems)
    assert built == [1]


def test_an_index_of_a_folder_is_found_wherever_it_is_moved_and_its_problems_are_there(tmp_path: Path) -> None:
    config = DiskCacheConfig(dir=str(tmp_path))
    broken = EpisodeTable.of([EpisodeInfo("one", 3)], problems=[EpisodeProblem("bad", "/data/set/a.npz: x", "damaged")])
    get_or_build(config, KEYS, "/data/set", lambda: broken)
    moved = IndexKeys.of({"files": 3}, "/mnt/set")
    table = get_or_build(config, moved, "/mnt/set", lambda: pytest.fail("built again"))
    assert [problem.where for problem in table.problems] == ["/mnt/set/a.npz: x"]
    assert fingerprints_of(table)[0] == KEYS.now == moved.now
    assert IndexKeys.of({"files": 4}, "/data/set").now != KEYS.now
    assert IndexKeys.of({"files": 3}, "/data/set", named="other/success").now != KEYS.now
    far = IndexKeys.of({"files": 3}, "gs://a/set")
    assert far.now == far.before != IndexKeys.of({"files": 3}, "gs://b/set").now, "servers say little of versions"


def test_an_index_of_an_earlier_version_is_found_and_so_is_what_was_made_by_its_key(tmp_path: Path) -> None:
    config, old = DiskCacheConfig(dir=str(tmp_path)), IndexKeys(KEYS.before, KEYS.before)
    get_or_build(config, old, "/data/set", lambda: TABLE)
    table = get_or_build(config, KEYS, "/data/set", lambda: pytest.fail("built again"))
    assert fingerprints_of(table) == (KEYS.now, KEYS.before)
    moved = get_or_build(config, IndexKeys.of({"files": 3}, "/mnt"), "/mnt", lambda: pytest.fail("built again"))
    assert fingerprints_of(moved) == (KEYS.now, KEYS.before), "also when it has moved since"
    with record_usage(rebuild=True):
        assert ids(get_or_build(config, KEYS, "/data/set", lambda: TABLE)) == ids(TABLE)


def test_whatever_is_damaged_the_table_is_built_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    config, chance = DiskCacheConfig(dir=str(tmp_path)), random.Random(0)  # noqa: S311 - no secret
    whole = get_or_build(config, KEYS, "/data/set", lambda: TABLE).to_bytes()
    [path] = (tmp_path / "index").iterdir()
    content = path.read_bytes()
    with caplog.at_level(logging.CRITICAL):
        for _ in range(300):
            damaged = bytearray(content)
            damaged[chance.randrange(len(damaged))] ^= 1 << chance.randrange(8)
            path.write_bytes(damaged[: len(damaged) if chance.random() < 0.9 else chance.randrange(len(damaged))])
            built: list[int] = []
            assert (
                get_or_build(config, KEYS, "/data/set", lambda built=built: built.append(1) or TABLE).to_bytes()
                == whole
            )
            assert built == [1]
            assert path.read_bytes() == content


def test_a_folder_that_cannot_be_written_costs_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(storage, "write_atomically", refuse)
    assert len(get_or_build(DiskCacheConfig(dir=str(tmp_path)), KEYS, "/data/set", lambda: TABLE)) == 5
    assert "No space left on device" in caplog.text


def test_two_that_write_one_index_at_once_do_not_meet(tmp_path: Path) -> None:
    here, there = threading.Barrier(2, timeout=120), threading.Barrier(2, timeout=120)

    def write(text: str) -> None:
        with storage.atomic_writer(tmp_path / "index") as file:
            file.write(text.encode())
            here.wait()
            if text == "second":
                there.wait()
        if text == "first":
            assert (tmp_path / "index").read_bytes() == b"first"
            there.wait()

    other = threading.Thread(target=write, args=["second"])
    other.start()
    write("first")
    other.join()
    assert (tmp_path / "index").read_bytes() == b"second"
    assert [path.name for path in tmp_path.iterdir()] == ["index"]


@pytest.mark.parametrize("named", ["config", "environment"])
def test_the_users_home_is_meant_by_a_tilde(named: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/somewhere")
    monkeypatch.setenv("VJEPA2_AC_CACHE", "~/kept")
    config = DiskCacheConfig(dir="~/kept" if named == "config" else None)
    assert cache_folder(config) == Path("/somewhere/kept")
    assert not os.path.lexists("~")
