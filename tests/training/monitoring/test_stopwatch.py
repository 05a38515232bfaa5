"""Waiting for data is measured by the host's clock, and on CUDA only while the device is idle."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import torch

from recording_cuda import RecordingCuda
from vjepa2_ac.data.clips.clip_reader import no_clips
from vjepa2_ac.episode import POSE_WIDTHS, Batch
from vjepa2_ac.training.monitoring import IdleStopwatch, Stopwatch, TimedBatches, stopwatch_for


class Machine(RecordingCuda):
    """A host and a device, each with its own time, in seconds: the device does one thing after another."""

    def __init__(self) -> None:
        super().__init__()
        self.host_s = self.device_s = 0.0

    def works(self, seconds: float) -> None:
        """Let the device get work, which the host does not wait for."""
        self.device_s = max(self.device_s, self.host_s) + seconds

    def timestamp(self) -> "Timestamp":
        self.works(0.0)
        return Timestamp(self, self.device_s)


@dataclass
class Timestamp:
    machine: Machine
    at_s: float

    def query(self) -> bool:
        return self.machine.host_s >= self.at_s

    def elapsed_time(self, later: "Timestamp") -> float:
        assert self.query()
        assert later.query(), "it would be an error to ask"
        return 1000 * (later.at_s - self.at_s)


def test_the_device_has_waited_where_it_ran_dry_before_the_batch_came() -> None:
    machine = Machine()
    watch = IdleStopwatch(machine)
    machine.works(5.0)
    with watch.running():
        machine.host_s += 3.0  # the device is still at work
    with watch.running():
        machine.host_s += 6.0  # it is ready after two of these
    assert watch.seconds == 4.0
    with watch.running():
        machine.host_s += 1.0  # it has nothing to do at all
    assert watch.seconds == 5.0


def test_what_the_device_has_not_come_to_counts_later_and_once() -> None:
    machine = Machine()
    watch = IdleStopwatch(machine)
    with watch.running():
        machine.host_s += 1.0
    machine.works(5.0)
    with pytest.raises(ZeroDivisionError), watch.running():
        raise ZeroDivisionError
    assert watch.seconds == 1.0
    machine.host_s += 9.0
    assert watch.seconds == 1.0
    assert not watch._spans


def test_batches_are_timed_also_when_they_are_fetched_ahead() -> None:
    machine = Machine()

    class Loader(Iterator[Batch]):
        def __next__(self) -> Batch:
            machine.host_s += 2.0
            return no_clips(2, POSE_WIDTHS, bytes_fetched=0)

        def prefetch_next(self) -> None:
            machine.host_s += 3.0

    batches = TimedBatches(Loader(), IdleStopwatch(machine))
    next(batches)
    assert batches.waited_s == 2.0
    machine.works(1.0)
    batches.prefetch_next()
    assert batches.waited_s == 4.0


def test_on_a_cpu_the_hosts_clock_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = stopwatch_for(torch.device("cpu"))
    assert isinstance(watch, Stopwatch)
    times = iter([10.0, 12.5])
    monkeypatch.setattr(time, "perf_counter", lambda: next(times))
    with watch.running():
        pass
    assert watch.seconds == 2.5


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_idle_time_of_a_cuda_device_is_measured() -> None:
    watch = stopwatch_for(torch.device("cuda"))
    with watch.running():
        time.sleep(0.05)
    torch.cuda.synchronize()
    assert watch.seconds > 0.04
