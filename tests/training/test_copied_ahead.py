"""Asynchronous copies do not change a run, and the next batch is copied before the host waits."""

from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader

from recording_cuda import RecordingCuda
from run_fixtures import set_up
from same_run import assert_same_run
from vjepa2_ac.data import streams
from vjepa2_ac.data.loader import Batches, training_loader
from vjepa2_ac.data.streams import ToDevice
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.run import Run
from vjepa2_ac.training.step import training_step

COPY = [*["side 1: to pinned memory", "side 1: to device"] * 3]  # frames, states, actions
USE = ["memory in use by computing"] * 3


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> RecordingCuda:
    """A device that records what is enqueued on it, and where the host reads the losses."""
    cuda = RecordingCuda()
    backward, tolist = torch.Tensor.backward, torch.Tensor.tolist

    def recorded(tensor: torch.Tensor) -> list[float]:
        if tensor.shape == (2,):
            cuda.calls.append("host: waits for the losses")
        return tolist(tensor)

    monkeypatch.setattr(torch.Tensor, "backward", lambda loss: (cuda.calls.append("backward"), backward(loss))[1])
    monkeypatch.setattr(torch.Tensor, "tolist", recorded)
    return cuda


def copied(run: Run, cuda: RecordingCuda) -> Batches:
    """Return the batches of a run, copied to a recording device."""
    rows = (one for one in training_loader(run.dataset, seed=0, batch_size=2))
    return Batches(rows, run.dataset.broken, ToDevice(cuda))


def micro_batch(event: int) -> list[str]:
    return [f"computing: waits for event {event}", *USE, "backward"]


def test_the_next_batch_is_on_its_way_before_the_host_waits_for_the_losses(make_config, reporter, cuda) -> None:
    run = set_up(make_config(), reporter)
    batches = copied(run, cuda)
    for step in (1, 2):
        training_step(run, batches, step)
    event = "side 1: event "
    assert cuda.calls == [
        *COPY, event + "1", *micro_batch(1), *COPY, event + "2", *micro_batch(2),
        *COPY, event + "3", "host: waits for the losses",
        *micro_batch(3), *COPY, event + "4", *micro_batch(4),
        *COPY, event + "5", "host: waits for the losses",
    ]  # fmt: skip


@pytest.fixture
def on_device(monkeypatch: pytest.MonkeyPatch) -> RecordingCuda:
    """Runs whose batches are copied to a recording device, ahead; the loader does not pin them."""

    def unpinned(*arguments: Any, pin_memory: bool, **knobs: Any) -> DataLoader:
        del pin_memory
        return DataLoader(*arguments, **knobs)

    cuda = RecordingCuda()
    copies = ToDevice(cuda)
    monkeypatch.setattr("vjepa2_ac.training.run.copies_for", lambda _: copies)
    monkeypatch.setattr(streams, "DataLoader", unpinned)
    return cuda


def test_a_run_that_copies_ahead_is_the_run_that_does_not(make_config, reporter, tmp_path, request) -> None:
    config = make_config(run_dir=str(tmp_path / "plain"), adapter__dropout=0.1)
    train(config, reporter)
    cuda = request.getfixturevalue("on_device")
    train(config.model_copy(update={"run_dir": str(tmp_path / "ahead")}), reporter)
    assert "side 1: to device" in cuda.calls
    assert_same_run(tmp_path / "ahead", tmp_path / "plain")
