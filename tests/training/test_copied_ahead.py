"""Asynchronous copies do not change a run, and the next batch is copied before the host waits."""

import itertools
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader

from recording_cuda import RecordingCuda
from run_fixtures import set_up
from same_run import assert_same_run
from vjepa2_ac.data import loader, streams
from vjepa2_ac.data.clips import ClipRequest
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import Batches, training_loader
from vjepa2_ac.data.streams import ToDevice
from vjepa2_ac.episode import Clip
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import read_state
from vjepa2_ac.training import setup
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.run import Run, batches_from
from vjepa2_ac.training.step import gradients, training_step

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


def test_after_the_last_step_and_in_a_trial_nothing_is_fetched_ahead(make_config, reporter, cuda) -> None:
    run = set_up(make_config(training__steps=1), reporter)
    training_step(run, copied(run, cuda), 1)
    assert cuda.calls[-1] == "host: waits for the losses"
    assert cuda.calls[-2] == "backward"
    cuda.calls.clear()
    gradients(run, copied(run, cuda))
    assert cuda.calls[-2:] == ["backward", "host: waits for the losses"]


@pytest.fixture
def on_device(monkeypatch: pytest.MonkeyPatch) -> RecordingCuda:
    """Runs whose batches are copied to a recording device, ahead; the loader does not pin them."""

    def unpinned(*arguments: Any, pin_memory: bool, **knobs: Any) -> DataLoader:
        del pin_memory
        return DataLoader(*arguments, **knobs)

    cuda = RecordingCuda()
    copies = ToDevice(cuda)
    monkeypatch.setattr(setup, "copies_for", lambda _: copies)
    monkeypatch.setattr(streams, "DataLoader", unpinned)
    return cuda


def test_a_run_that_copies_ahead_is_the_run_that_does_not(make_config, reporter, tmp_path, request) -> None:
    config = make_config(run_dir=str(tmp_path / "plain"), adapter__dropout=0.1)
    train(config, reporter)
    cuda = request.getfixturevalue("on_device")
    train(config.model_copy(update={"run_dir": str(tmp_path / "ahead")}), reporter)
    assert "side 1: to device" in cuda.calls
    assert_same_run(tmp_path / "ahead", tmp_path / "plain")


def test_a_checkpoint_knows_nothing_of_the_clips_of_the_next_step(make_config, reporter, monkeypatch, request) -> None:
    read, config = loader.read_clip, make_config(data__broken_episodes="skip", checkpoint__every=1)
    third = next(itertools.islice(batches_from(set_up(config, reporter)), 4, None))  # of two in each step
    bad = (third.episode_ids[0], third.starts[0])

    def read_some(dataset: Dataset, wish: ClipRequest) -> Clip:
        if (dataset.table.identity(wish.episode), wish.start) == bad:
            raise InputError(where="here", found="damaged")
        return read(dataset, wish)

    monkeypatch.setattr(loader, "read_clip", read_some)
    request.getfixturevalue("on_device")
    train(config, reporter)
    folders = [Path(config.run_dir) / f"checkpoints/step-{step:08d}" for step in (2, 3)]
    assert [dict(read_state(folder).data[0].broken) for folder in folders] == [{}, {bad[0]: "here: damaged."}]


def test_a_clip_that_cannot_be_read_stops_the_run_at_its_own_step(
    make_config, reporter, monkeypatch, on_device: Any
) -> None:
    read, config = loader.read_clip, make_config()
    positions = itertools.count()

    def read_some(*arguments: Any) -> Clip:
        if next(positions) == 4 * 2:  # the first clip of the third step
            raise InputError(where="here", found="damaged")
        return read(*arguments)

    del on_device
    run = set_up(config, reporter)
    monkeypatch.setattr(loader, "read_clip", read_some)
    batches = batches_from(run)
    for step in (1, 2):
        training_step(run, batches, step)
    with pytest.raises(InputError, match="damaged"):
        training_step(run, batches, 3)
