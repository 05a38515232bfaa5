"""Asynchronous copies to the device do not change a run."""

from typing import Any

import pytest
from torch.utils.data import DataLoader

from recording_cuda import RecordingCuda
from same_run import assert_same_run
from vjepa2_ac.data import streams
from vjepa2_ac.data.streams import ToDevice
from vjepa2_ac.training.loop import train


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
