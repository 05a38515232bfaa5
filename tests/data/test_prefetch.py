"""Prefetching: a batch is being copied to the device, and not reported before its turn."""

from collections.abc import Generator
from dataclasses import replace

import pytest
import torch

from recording_cuda import RecordingCuda
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.loader import Batches, prefetch_next
from vjepa2_ac.data.selection import BrokenEpisodes
from vjepa2_ac.data.streams import ToDevice
from vjepa2_ac.episode import Batch, Skipped
from vjepa2_ac.errors import InputError

TO_DEVICE = ["side 1: to pinned memory", "side 1: to device"]


def batch(number: int) -> Batch:
    return Batch(None, torch.full((1, 2, 7), number), torch.full((1, 1, 7), number), None, (f"e{number}",), (number,))


class Rows:
    """Rows of a loader: numbered batches of which the clips of some could not be read, then an error or the end."""

    def __init__(self, count: int, skipped: tuple[int, ...] = (), error: Exception | None = None) -> None:
        self.fetched, self.closed = 0, False
        self._count, self._skipped, self._error = count, skipped, error

    def __call__(self) -> Generator[Batch | InputError, None, None]:
        try:
            for number in range(self._count):
                self.fetched += 1
                skipped = (Skipped(f"e{number}", "damaged"),) if number in self._skipped else ()
                yield replace(batch(number), skipped=skipped)
            if isinstance(self._error, InputError):
                yield self._error  # as a worker sends one home
            elif self._error is not None:
                raise self._error
        finally:
            self.closed = True


@pytest.fixture
def cuda() -> RecordingCuda:
    return RecordingCuda()


def batches_of(rows: Rows, copies: ToDevice | None) -> Batches:
    return Batches(rows(), BrokenEpisodes(DataConfig(path="x", broken_episodes="skip"), 1000), copies)


def test_a_batch_fetched_ahead_is_copied_at_once_and_comes_in_its_turn(cuda: RecordingCuda) -> None:
    rows = Rows(3)
    batches = batches_of(rows, ToDevice(cuda))
    first = next(batches)
    assert rows.fetched == 1
    cuda.calls.clear()
    prefetch_next(batches)
    prefetch_next(batches)  # one is enough
    assert rows.fetched == 2
    assert cuda.calls == [*TO_DEVICE * 2, "side 1: event 2"]
    second = next(batches)
    assert rows.fetched == 2
    assert [one.starts for one in (first, second, *batches)] == [(0,), (1,), (2,)]


def test_the_copy_on_the_device_is_given_once_and_the_batch_stays(cuda: RecordingCuda) -> None:
    given = next(batches_of(Rows(3), ToDevice(cuda)))
    cuda.calls.clear()
    there = given.on_device()
    assert cuda.calls == ["computing: waits for event 1", *["memory in use by computing"] * 2]
    assert torch.equal(there.states, given.states)
    assert there.states is not given.states
    assert there.starts == given.starts
    assert given.on_device() is None


@pytest.mark.parametrize("error", [InputError(where="x", found="damaged"), RuntimeError("a worker died"), None])
def test_what_goes_wrong_ahead_is_raised_when_its_turn_has_come(cuda: RecordingCuda, error: Exception | None) -> None:
    rows = Rows(2, error=error)
    batches = batches_of(rows, ToDevice(cuda))
    for number in range(2):
        assert next(batches).starts == (number,)
        prefetch_next(batches)
    with pytest.raises(StopIteration if error is None else type(error)) as caught:
        next(batches)
    assert error is None or caught.value is error
    assert rows.closed
    with pytest.raises(StopIteration):
        next(batches)


def test_clips_left_out_ahead_are_noted_when_their_turn_has_come(cuda: RecordingCuda) -> None:
    broken = BrokenEpisodes(DataConfig(path="x", broken_episodes="skip"), 1000)
    batches = Batches(Rows(2, skipped=(1,))(), broken, ToDevice(cuda))
    next(batches)
    prefetch_next(batches)
    assert broken.reasons == {}
    next(batches)
    assert broken.reasons == {"e1": "damaged"}
