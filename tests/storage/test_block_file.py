"""Block files and the disk cache: few extra bytes are fetched, once per machine, within a size limit."""

import errno
import io
import logging
import os
import pickle
import sys
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from accidents import without_permission
from gcs import Gcs
from run_fixtures import Popen
from vjepa2_ac import storage
from vjepa2_ac.storage import block_file
from vjepa2_ac.storage.block_file import BLOCK_BYTES, BlockCachedFile, DiskCache, RangedFile

MB = 1 << 20
DATA = bytes(i * 7 % 251 for i in range(3000))


class FetchRecorder:
    """A file in memory that records the fetched ranges."""

    def __init__(self, data: bytes) -> None:
        self.data, self.fetches = data, []
        self.file = RangedFile(self.fetch, len(data))

    def fetch(self, start: int, length: int) -> bytes:
        assert 0 <= start < start + length <= len(self.data)
        self.fetches.append((start, length))
        return self.data[start : start + length]

    @property
    def bytes(self) -> int:
        return sum(length for _, length in self.fetches)


STEPS = st.lists(
    st.tuples(st.sampled_from(["set", "end", "read", "readinto"]), st.integers(-1, 3500)), min_size=1, max_size=40
)


@settings(max_examples=150)
@given(size=st.integers(0, 3000), steps=STEPS)
def test_reading_and_seeking_equal_those_of_a_file_in_memory(size: int, steps: list[tuple[str, int]]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(block_file, "BLOCK_BYTES", 64)
        patch.setattr(block_file, "_CACHED_BLOCKS", 8)
        data = DATA[:size]
        file, reference = FetchRecorder(data).file, io.BytesIO(data)
        for kind, number in steps:
            if kind == "set":
                assert file.seek(max(number, 0)) == reference.seek(max(number, 0))
            elif kind == "end":
                assert file.seek(-min(number, size), os.SEEK_END) == reference.seek(-min(number, size), os.SEEK_END)
            elif kind == "read":
                assert file.read(number) == reference.read(number)
            else:
                buffer, expected = bytearray(max(number, 0)), bytearray(max(number, 0))
                assert file.readinto(buffer) == reference.readinto(expected)
                assert buffer == expected
            assert file.tell() == reference.tell()


def test_seek_fetches_one_block_and_cached_blocks_none() -> None:
    recorder = FetchRecorder(bytes(100 * MB))
    recorder.file.read(32)
    recorder.file.seek(-50_000, os.SEEK_END)
    recorder.file.read(50_000)
    recorder.file.seek(50 * MB)
    recorder.file.read(40_000)
    assert recorder.bytes <= 5 * 128 * 1024
    before = len(recorder.fetches)
    recorder.file.seek(5)
    recorder.file.read(32)
    assert len(recorder.fetches) == before


def test_sequential_reads_double_the_fetch_size() -> None:
    recorder = FetchRecorder(bytes(64 * MB))
    while recorder.file.read(32 * 1024):
        pass
    assert len(recorder.fetches) <= 24
    assert recorder.bytes == 64 * MB
    recorder = FetchRecorder(bytes(64 * MB))
    recorder.file.seek(10 * MB + 5)
    assert len(recorder.file.read(7 * MB)) == 7 * MB
    assert len(recorder.fetches) == 1
    assert recorder.bytes <= 7 * MB + 2 * 128 * 1024


def test_block_is_fetched_once_per_machine_and_version(gcs: Gcs, tmp_path: Path) -> None:
    data = os.urandom(5 * BLOCK_BYTES + 77)
    url, cache = gcs.put("bucket/file", data), DiskCache(tmp_path, 10 * MB)

    def open_file(version: str = "1") -> BlockCachedFile:
        return BlockCachedFile(url, version=version, size=len(data), cache=cache)

    first = open_file()
    first.seek(2 * BLOCK_BYTES + 5)
    assert first.read(10) == data[2 * BLOCK_BYTES + 5 :][:10]
    before = storage.bytes_fetched()
    assert open_file().read() == data
    assert storage.bytes_fetched() - before == len(data) - BLOCK_BYTES
    assert open_file().read() == data
    assert storage.bytes_fetched() - before == len(data) - BLOCK_BYTES
    open_file("2").read(1)
    assert storage.bytes_fetched() - before == len(data)
    gcs.fail_next(404, times=9)
    broken = BlockCachedFile(url, version="3", size=len(data), cache=cache)
    with pytest.raises(FileNotFoundError):
        broken.read(1)
    assert isinstance(broken.failure, FileNotFoundError)


# ---- the disk cache ----


def entries(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "lock")


def compute_size(folder: Path) -> int:
    return sum(path.stat().st_size for path in entries(folder))


def test_entry_is_readable_by_each_cache_of_the_folder(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path / "new", 1000)
    assert cache.read("gs://a/b 0-10") is None
    cache.write("gs://a/b 0-10", b"first")
    cache.write("gs://a/b 0-10", b"second")
    for other in (cache, DiskCache(tmp_path / "new", 1000), pickle.loads(pickle.dumps(cache))):  # noqa: S301 - our own
        assert other.read("gs://a/b 0-10") == b"second"
        assert other.read("gs://a/b 0-11") is None
    [path] = entries(tmp_path)
    content = path.read_bytes()
    for damaged in (b"", content[:-1], b"S" + content[1:], bytes(len(content))):
        path.write_bytes(damaged)
        assert cache.read("gs://a/b 0-10") is None, "such as after a power failure"


def test_parts_are_read_by_number_and_damaged_entries_are_absent(tmp_path: Path) -> None:
    cache, parts = DiskCache(tmp_path, 10_000), [b"first", b"second", b"third" * 100, b"last"]
    assert cache.read_parts("a", 4, [0]) is None
    cache.write_parts("a", parts)
    assert cache.read_parts("a", 4, [3, 1, 2, 2, 0]) == [parts[number] for number in (3, 1, 2, 2, 0)]
    assert cache.read_parts("a", 4, []) == []
    assert cache.read_parts("a", 4, [4]) is None
    path = cache._path("a")
    data = path.read_bytes()
    for index in (*range(0, 80, 3), data.index(b"thirdthird") + 7):  # in the table of the parts, and in a part
        path.write_bytes(data[:index] + bytes([data[index] ^ 255]) + data[index + 1 :])
        assert cache.read_parts("a", 4, [0, 1, 2, 3]) is None
        assert cache.read_parts("a", 4, [3]) in (None, [b"last"])
    path.write_bytes(data[:-20])
    assert cache.read_parts("a", 4, [2, 3]) is None
    path.write_bytes(b"")
    assert cache.read_parts("a", 4, [0]) is None


def test_least_recently_used_entry_is_evicted_first(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path, 410)
    for second, key in enumerate("abcd"):
        before = set(entries(tmp_path))
        cache.write(key, bytes(96))
        [new] = set(entries(tmp_path)) - before
        os.utime(new, (second, second))  # because the time stamps of file systems are coarse
    assert cache.read("a") is not None
    cache.write("e", bytes(96))
    assert [key for key in "abcde" if cache.read(key) is not None] == ["a", "d", "e"], "evicted to 80 % of the limit"


@settings(max_examples=30)
@example(writes=[(0, 1), (0, 172), (0, 796), (0, 16)], is_shared=True)
@example(writes=[(0, 10 + size) for size in range(80)], is_shared=False)
@given(writes=st.lists(st.tuples(st.integers(0, 9), st.integers(1, 1000)), max_size=30), is_shared=st.booleans())
def test_size_limit_holds_and_newest_entry_is_present(
    tmp_path_factory: pytest.TempPathFactory, writes: list[tuple[int, int]], *, is_shared: bool
) -> None:
    folder = tmp_path_factory.mktemp("cache")
    cache = DiskCache(folder, 1000)
    for key, size in writes:
        cache = cache if is_shared else DiskCache(folder, 1000)  # a new cache object, as in another process
        cache.write(f"{key} {size}", bytes(size))
        assert (cache.read(f"{key} {size}") == bytes(size)) == (size + 4 <= 800)
        assert compute_size(folder) <= 1000
    DiskCache(folder / "none", 0).write("a", b"1")
    assert not (folder / "none").exists()


@pytest.mark.parametrize("fault", ["full", "no folder"])
def test_unwritable_disk_logs_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, fault: str
) -> None:
    (tmp_path / "file").touch()
    folder = tmp_path / "file" / "inner" if fault == "no folder" else tmp_path / "cache"
    cache = DiskCache(folder, 1000)

    def raise_disk_full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    if fault == "full":
        monkeypatch.setattr(Path, "replace", raise_disk_full)
    cache.write("a", b"first")
    cache.write("b", b"second")
    assert cache.read("a") is None
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert entries(tmp_path) == [tmp_path / "file"]


def fill(folder: Path, entries: int) -> None:
    """Write entries of 100 bytes under the keys 0, 1, ..., in this order of use."""
    for key in range(entries):
        before = set(folder.rglob("*"))
        DiskCache(folder, 10_000).write(str(key), bytes(96))
        [new] = [path for path in set(folder.rglob("*")) - before if path.is_file() and path.name != "lock"]
        os.utime(new, (key, key))


@pytest.mark.parametrize("is_unknown", [False, True], ids=["known total", "unknown total"])
def test_first_write_reduces_a_folder_over_the_limit(tmp_path: Path, *, is_unknown: bool) -> None:
    fill(tmp_path, 20)
    if is_unknown:
        (tmp_path / "lock").write_bytes(b"")
    cache = DiskCache(tmp_path, 1000)
    assert compute_size(tmp_path) == 2000
    cache.write("new", bytes(96))
    assert compute_size(tmp_path) == 800
    assert cache.read("new") is not None
    assert cache.read("0") is None
    assert cache.read("18") is not None


def test_zero_limit_and_no_limit_evict_nothing(tmp_path: Path) -> None:
    fill(tmp_path, 20)
    for limit in (0, None):
        cache = DiskCache(tmp_path, limit)
        cache.write("new", bytes(96))
        assert cache.read("0") == bytes(96)
        assert (cache.read("new") is None) == (limit == 0)
    assert compute_size(tmp_path) == 2100


WRITE_MANY = """
import sys
from concurrent.futures import ThreadPoolExecutor
from vjepa2_ac.storage.block_file import DiskCache

cache = DiskCache(sys.argv[1], int(sys.argv[2]))
first = int(sys.argv[3])

def write_and_read(number):
    key = (first + number) % 250
    cache.write(str(key), bytes([key]) * (1 + key))
    other = number * 7 % 250
    assert cache.read(str(other)) in (None, bytes([other]) * (1 + other))

with ThreadPoolExecutor(2) as pool:
    list(pool.map(write_and_read, range(300)))
"""


def test_size_limit_holds_with_concurrent_writers(popen: Popen, tmp_path: Path) -> None:
    limit, max_in_progress = 20_000, 4 * 2 * 255  # all entries have 33,000 bytes
    writers = [
        popen([sys.executable, "-c", WRITE_MANY, str(tmp_path), str(limit), str(60 * first)]) for first in range(4)
    ]
    assert [writer.wait(timeout=120) for writer in writers] == [0] * 4
    assert compute_size(tmp_path) <= limit + max_in_progress
    assert compute_size(tmp_path) > limit / 2
    assert not list(tmp_path.rglob("*.partial"))


def test_entry_without_permission_is_fetched_again_and_not_replaced(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache = DiskCache(tmp_path, None)
    cache.write_parts("key", [b"first", b"second"])
    entry = cache._path("key")
    before = entry.read_bytes()
    with without_permission(entry):
        for _ in range(2):
            assert cache.read("key") is None
            assert cache.read_parts("key", 2, [0]) is None
            cache.write("key", b"other")
    (warning,) = (record.getMessage() for record in caplog.records)
    assert warning.startswith(f"{entry}: the disk cache cannot be used (Permission denied (mode 0000, owner uid")
    assert entry.read_bytes() == before
    assert DiskCache(tmp_path, None).read_parts("key", 2, [1]) == [b"second"]
