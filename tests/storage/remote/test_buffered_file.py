"""The ranged file: reads like a file, and fetches little more than is read."""

import io
import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vjepa2_ac.storage.remote import buffered_file
from vjepa2_ac.storage.remote.buffered_file import RangedFile

MB = 1 << 20
DATA = bytes(i * 7 % 251 for i in range(3000))


class Served:
    """Bytes that count what is fetched of them."""

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
        patch.setattr(buffered_file, "BLOCK_BYTES", 64)
        patch.setattr(buffered_file, "_CACHED_BLOCKS", 8)
        data = DATA[:size]
        ours, theirs = Served(data).file, io.BytesIO(data)
        for kind, number in steps:
            if kind == "set":
                assert ours.seek(max(number, 0)) == theirs.seek(max(number, 0))
            elif kind == "end":
                assert ours.seek(-min(number, size), os.SEEK_END) == theirs.seek(-min(number, size), os.SEEK_END)
            elif kind == "read":
                assert ours.read(number) == theirs.read(number)
            else:
                mine, its = bytearray(max(number, 0)), bytearray(max(number, 0))
                assert ours.readinto(mine) == theirs.readinto(its)
                assert mine == its
            assert ours.tell() == theirs.tell()


def test_a_jump_costs_a_block_and_what_is_at_hand_nothing() -> None:
    served = Served(bytes(100 * MB))
    served.file.read(32)
    served.file.seek(-50_000, os.SEEK_END)
    served.file.read(50_000)
    served.file.seek(50 * MB)
    served.file.read(40_000)
    assert served.bytes <= 5 * 128 * 1024
    before = len(served.fetches)
    served.file.seek(5)
    served.file.read(32)
    assert len(served.fetches) == before


def test_reading_on_takes_fewer_and_fewer_fetches() -> None:
    served = Served(bytes(64 * MB))
    while served.file.read(32 * 1024):
        pass
    assert len(served.fetches) <= 24
    assert served.bytes == 64 * MB


def test_a_long_read_is_one_fetch_of_its_blocks() -> None:
    served = Served(bytes(64 * MB))
    served.file.seek(10 * MB + 5)
    assert len(served.file.read(7 * MB)) == 7 * MB
    assert len(served.fetches) == 1
    assert served.bytes <= 7 * MB + 2 * 128 * 1024


def test_a_file_that_was_closed_is_not_read() -> None:
    served = Served(b"123")
    with served.file as file:
        assert (file.readable(), file.seekable(), file.read(1)) == (True, True, b"1")
    with pytest.raises(ValueError, match="closed"):
        served.file.read(1)
    with pytest.raises(ValueError, match="negative"):
        Served(b"123").file.seek(-1)
