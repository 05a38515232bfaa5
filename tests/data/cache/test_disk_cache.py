"""The disk cache: fetched data is stored, undamaged, up to the limit."""

import errno
import logging
import os
import pickle
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vjepa2_ac.data.cache.disk_cache import DiskCache

HEADER = 16


def entries(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "ledger")


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in entries(folder))


def test_what_is_written_is_read_by_every_cache_on_the_folder(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path / "new", 1000)
    assert cache.read("gs://a/b 0-10") is None
    cache.write("gs://a/b 0-10", b"first")
    cache.write("gs://a/b 0-10", b"second")
    cache.write("empty", b"")
    for other in (cache, DiskCache(tmp_path / "new", 1000), pickle.loads(pickle.dumps(cache))):  # noqa: S301 - our own
        assert other.read("gs://a/b 0-10") == b"second"
        assert other.read("empty") == b""
        assert other.read("gs://a/b 0-11") is None


def test_the_entry_used_longest_ago_goes_first(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path, 4 * 100)
    for second, key in enumerate("abcd"):
        before = set(entries(tmp_path))
        cache.write(key, bytes(100 - HEADER))
        [new] = set(entries(tmp_path)) - before
        os.utime(new, (second, second))  # the clock of a file system is coarse
    assert cache.read("a") is not None
    cache.write("e", bytes(100 - HEADER))
    assert [key for key in "abcde" if cache.read(key) is not None] == ["a", "d", "e"], "one more, for room"


def test_a_folder_that_may_only_be_read_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    DiskCache(tmp_path, 1000).write("a", b"content")

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "utime", refuse)
    monkeypatch.setattr(Path, "open", lambda path, mode="r", **_: open(path, mode) if "w" not in mode else refuse())  # noqa: PTH123, SIM115 - what is replaced
    cache = DiskCache(tmp_path, 1000)
    cache.write("b", b"content")
    assert cache.read("a") == b"content"
    assert cache.read("b") is None


@settings(max_examples=30)
@given(writes=st.lists(st.tuples(st.integers(0, 9), st.integers(0, 700)), max_size=30))
def test_the_limit_holds_after_every_write(
    tmp_path_factory: pytest.TempPathFactory, writes: list[tuple[int, int]]
) -> None:
    folder = tmp_path_factory.mktemp("cache")
    cache = DiskCache(folder, 1000)
    for key, size in writes:
        cache.write(str(key), bytes(size))
        assert cache.read(str(key)) == bytes(size)
        assert size_of(folder) <= 1000
        assert int((folder / "ledger").read_text()) == size_of(folder)


def test_an_entry_larger_than_the_limit_is_not_kept_and_costs_no_other(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path, 100)
    cache.write("small", b"small")
    cache.write("large", bytes(101))
    assert cache.read("large") is None
    assert cache.read("small") == b"small"
    DiskCache(tmp_path / "none", 0).write("a", b"")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("damage", [b"", b"short", b"flip", b"longer"])
def test_a_damaged_entry_counts_as_absent_and_can_be_written_again(
    tmp_path: Path, damage: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    cache = DiskCache(tmp_path, 1000)
    cache.write("a", b"precious data")
    [path] = entries(tmp_path)
    content = bytearray(path.read_bytes())
    if damage == b"flip":
        content[-1] ^= 1
    path.write_bytes({b"flip": bytes(content), b"longer": bytes(content) + b"x"}.get(damage, damage))
    assert cache.read("a") is None
    assert "damaged" in caplog.text
    cache.write("a", b"precious data")
    assert cache.read("a") == b"precious data"


def test_entries_are_not_indexed_before_the_limit_is_reached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = DiskCache(tmp_path, 100_000)
    cache.write("first", b"")  # there is no ledger yet
    looks = []
    scan = os.scandir
    monkeypatch.setattr("os.scandir", lambda path: looks.append(str(path)) or scan(path))  # type: ignore[func-returns-value]
    for number in range(900):
        cache.write(str(number), bytes(100 - HEADER))
    assert looks == []
    for number in range(900, 1900):
        cache.write(str(number), bytes(100 - HEADER))
    times = looks.count(str(tmp_path))
    assert 5 <= times <= 15, "each look frees a tenth of the limit, here a hundred entries"


@pytest.mark.parametrize("ledger", ["", "nonsense", "0", "999999"])
def test_a_wrong_ledger_is_put_right_when_the_limit_is_reached(tmp_path: Path, ledger: str) -> None:
    cache = DiskCache(tmp_path, 1000)
    for key in "abc":
        cache.write(key, bytes(84))
    (tmp_path / "ledger").write_text(ledger)
    for number in range(20):
        cache.write(str(number), bytes(84))
    assert cache.read("19") is not None
    assert size_of(tmp_path) <= 1000 + (300 if ledger == "0" else 0)


def test_a_full_disk_costs_one_warning_and_not_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    cache = DiskCache(tmp_path, 1000)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        cache.write("a", b"first")
        cache.write("b", b"second")
    assert caplog.text.count("No space left") == 1
    assert entries(tmp_path) == []
    cache.write("a", b"first")
    assert cache.read("a") == b"first"


def test_a_folder_that_cannot_be_made_costs_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").touch()
    cache = DiskCache(tmp_path / "file" / "inner", 1000)
    cache.write("a", b"first")
    assert cache.read("a") is None
    assert [record.levelno for record in caplog.records] == [logging.WARNING]


def test_what_an_interrupted_writer_left_behind_goes_when_room_is_made(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path, 1000)
    cache.write("a", b"first")
    inner = entries(tmp_path)[0].parent
    old, fresh = inner / ".x.1.1.partial", inner / ".y.1.1.partial"
    for path in (old, fresh):
        path.write_bytes(bytes(500))
    os.utime(old, (0, 0))
    (tmp_path / "ledger").unlink()
    cache.write("b", bytes(500))
    assert not old.exists()
    assert fresh.exists()
    assert cache.read("a") == b"first"


WRITE_MANY = """
import sys
from concurrent.futures import ThreadPoolExecutor
from vjepa2_ac.data.cache.disk_cache import DiskCache

cache = DiskCache(sys.argv[1], 5000)

def once(number):
    key = number % 37
    cache.write(str(key), bytes([key]) * (key * 20))
    other = number * 7 % 37
    assert cache.read(str(other)) in (None, bytes([other]) * (other * 20))

with ThreadPoolExecutor(4) as pool:
    list(pool.map(once, range(150)))
"""


def test_several_processes_and_threads_share_a_folder(popen, tmp_path: Path) -> None:
    writers = [popen([sys.executable, "-c", WRITE_MANY, str(tmp_path)]) for _ in range(2)]
    assert [writer.wait(timeout=120) for writer in writers] == [0, 0]
    assert 0 < size_of(tmp_path) <= 5000
    assert int((tmp_path / "ledger").read_text()) == size_of(tmp_path)
    assert not list(tmp_path.rglob("*.partial"))
