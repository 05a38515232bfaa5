"""Loader workers: a run never waits forever, and shared memory is checked."""

import contextlib
import signal
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from clips import open_memory_source
from failing_rows import Rows
from memory_source import MemorySource
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data import loader
from vjepa2_ac.data.loader import map_in_workers, require_shared_memory
from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.process import StopRequest
from vjepa2_ac.training.setup import set_up

Usage = namedtuple("Usage", "free")


@pytest.fixture
def shared_memory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Return a function that sets the free bytes of shared memory."""
    monkeypatch.setattr(loader, "SHARED_MEMORY", tmp_path)
    real = loader.shutil.disk_usage

    def set_free(free: int) -> None:
        def usage(path: object) -> Any:
            return Usage(free) if path == tmp_path else real(path)

        monkeypatch.setattr(loader.shutil, "disk_usage", usage)

    return set_free


def data(workers: int) -> DataConfig:
    return DataConfig(path="none", workers=workers)


@pytest.mark.parametrize(("workers", "processes"), [(4, 1), (2, 2)])
def test_shared_memory_smaller_than_all_batches_raises(shared_memory: Any, workers: int, processes: int) -> None:
    needed = 1000 * workers * loader.PREFETCH * processes
    shared_memory(needed)
    require_shared_memory(data(workers), 1000, processes)
    shared_memory(needed - 1)
    with pytest.raises(UnreachableError, match=r"--shm-size=8g or --ipc=host.*data\.workers=0"):
        require_shared_memory(data(workers), 1000, processes)
    require_shared_memory(data(0), 1000, processes)


def test_shared_memory_check_is_skipped_without_shared_memory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(loader, "SHARED_MEMORY", tmp_path / "none")
    require_shared_memory(data(4), 10**18)


def test_too_little_shared_memory_raises_before_the_first_step(make_config: Any, shared_memory: Any) -> None:
    frames = 2 * 4 * 36 * 49 * 3  # a batch of two clips of 4 frames, and 49 numbers of states and actions each
    shared_memory(2 * loader.PREFETCH * (frames + 2 * 4 * (4 * 7 + 3 * 7)) - 1)
    with pytest.raises(UnreachableError, match=r"2 workers x 2 prefetched batches of 0\.0427 MB"):
        set_up(make_config(data__workers=2))
    set_up(make_config(data__workers=0))


def test_full_shared_memory_raises_from_the_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: torch.Tensor) -> torch.Tensor:
        raise RuntimeError("unable to allocate shared memory(shm)")

    monkeypatch.setattr(loader, "get_worker_info", lambda: True)
    dataset = open_memory_source(MemorySource([30] * 4))
    with contextlib.closing(loader.training_loader(dataset, seed=0, batch_size=2)) as batches:
        assert next(batches).frames.is_shared()
        monkeypatch.setattr(torch.Tensor, "share_memory_", full)
        with pytest.raises(UnreachableError, match=r"not enough space for a batch .* MB .*unable to allocate.*--ipc"):
            next(batches)


def take_all(failure: str) -> list[list[int]]:
    return list(map_in_workers(Rows(failure), ([number] for number in range(4)), 1))


def test_dead_or_blocked_worker_raises() -> None:
    assert take_all("") == [[0], [1], [2], [3]]
    for failure, status in (("dies", 9), ("cannot be sent", 1)):
        with pytest.raises(UnreachableError, match=rf"worker has ended unexpectedly \(exit code {status}\)"):
            take_all(failure)


class Slow(Iterator[int]):
    """An iterator that times out twice before its result, or raises another error."""

    def __init__(self, error: str = "DataLoader timed out after 1.0 seconds") -> None:
        self.errors = [RuntimeError(error)] * 2

    def __next__(self) -> int:
        if self.errors:
            raise self.errors.pop()
        return 7


def test_slow_batch_is_awaited_unless_a_stop_signal_arrived(monkeypatch: pytest.MonkeyPatch) -> None:
    assert loader._next_result(Slow(), ()) == 7
    with pytest.raises(RuntimeError, match="another"):
        loader._next_result(Slow("another"), ())
    stop = StopRequest()
    stop.record(signal.SIGTERM, None)
    stop._received_at -= 100.0
    monkeypatch.setattr(loader, "stop_request", lambda: stop)
    assert loader._next_result(Slow(), ()) == 7, "only a wait after the signal counts"
    monkeypatch.setattr(loader, "_GRACE_S", 0.0)
    with pytest.raises(UnreachableError, match="no batch arrived after SIGTERM"):
        loader._next_result(Slow(), ())
