"""Copies: they overlap with computation, and only their users wait, for these copies only."""

import pytest
import torch

from recording_cuda import COMPUTING, RecordingCuda
from vjepa2_ac.data.streams import ToDevice, copies_for
from vjepa2_ac.episode import Batch, StoredLatents


def batch(count: int = 2) -> Batch:
    """Return a batch with every tensor that there may be."""
    return Batch(
        frames=torch.arange(count * 12, dtype=torch.uint8).reshape(count, 2, 1, 2, 3),
        states=torch.rand(count, 2, 7), actions=torch.rand(count, 1, 7), extrinsics=torch.rand(count, 2, 6),
        episode_ids=("a",) * count, starts=tuple(range(count)),
        latents=StoredLatents(torch.ones(count, 2, 3, 4, dtype=torch.int8), torch.rand(count, 2, 3)),
    )  # fmt: skip


def tensors(of: Batch | StoredLatents) -> list[torch.Tensor]:
    found: list[torch.Tensor] = []

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        found.append(tensor)
        return tensor

    of.mapped(keep)
    return found


def assert_equal(one: Batch | StoredLatents, other: Batch | StoredLatents) -> None:
    assert len(tensors(one)) == len(tensors(other))
    assert all(map(torch.equal, tensors(one), tensors(other)))


@pytest.fixture
def pinned(monkeypatch: pytest.MonkeyPatch) -> None:
    """All memory is pinned."""
    monkeypatch.setattr(torch.Tensor, "is_pinned", lambda _: True)


@pytest.mark.usefixtures("pinned")
def test_a_copy_to_the_device_is_on_its_way_at_once_and_only_computing_waits_for_it() -> None:
    cuda = RecordingCuda()
    given = batch()
    taken = ToDevice(cuda).start(given.mapped)
    assert cuda.calls == ["side 1: to device"] * 6 + ["side 1: event 1"]
    cuda.calls.clear()
    assert_equal(taken(), given)
    assert cuda.calls == [f"{COMPUTING}: waits for event 1"] + [f"memory in use by {COMPUTING}"] * 6


def test_what_is_not_pinned_is_pinned_first() -> None:
    cuda, tensor = RecordingCuda(), torch.ones(2)
    ToDevice(cuda).start(lambda copy: copy(tensor))
    assert cuda.calls[:2] == ["side 1: to pinned memory", "side 1: to device"]


def test_on_a_cpu_nothing_is_copied() -> None:
    assert copies_for(torch.device("cpu")) is None


def test_a_batch_is_as_large_as_its_tensors() -> None:
    assert batch(3).nbytes == 3 * (2 * 6 + 4 * (2 * 7 + 7 + 2 * 6) + 2 * 3 * 4 + 4 * 2 * 3)
