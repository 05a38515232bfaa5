"""Two machines with one mirror: the later start keeps it, and the earlier one is warned."""

import json
import logging
from pathlib import Path

import pytest

from vjepa2_ac import storage
from vjepa2_ac.config import CheckpointConfig
from vjepa2_ac.runs.checkpoint import RunState, checkpoint_name, write_checkpoint
from vjepa2_ac.runs.folder import ENVIRONMENT, open_run_folder
from vjepa2_ac.runs.mirror.background_sync import Mirror
from vjepa2_ac.runs.mirror.remote_checkpoints import RemoteCheckpoints, complete
from vjepa2_ac.runs.mirror.upload import RemoteUpdate


class Machine:
    """Trains, and lets each checkpoint be sent."""

    def __init__(self, folder: Path, place: str, run_id: str = "mine") -> None:
        self.folder, self.run_id = folder, run_id
        config = CheckpointConfig(keep=3, remote=place, remote_every_minutes=0.0)
        self.mirror = Mirror(RemoteUpdate(RemoteCheckpoints(place), folder, run_id, config.keep), config)

    def go_on(self, *steps: int) -> None:
        def files(folder: Path) -> None:
            (folder / "optimizer.pt").write_bytes(f"{self.folder.name} {steps}".encode())

        for step in steps:
            write_checkpoint(self.folder / "checkpoints", RunState(step, run_id=self.run_id), files, keep=3)
            self.mirror.tick()
            if self.mirror._thread is not None:
                self.mirror._thread.join()


@pytest.fixture
def place(tmp_path: Path) -> str:
    return str(tmp_path / "disk")


@pytest.fixture
def machine(tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch, make_config):
    def start(name: str, run_id: str = "mine") -> Machine:
        folder = tmp_path / name
        monkeypatch.setattr("platform.node", lambda: name)
        open_run_folder(make_config(run_dir=str(folder)), run_id)
        return Machine(folder, place, run_id)

    return start


def content(place: str) -> dict[str, bytes]:
    return {name: storage.read_bytes(storage.join(place, name)) for name in storage.file_sizes(place)}


def test_the_later_start_keeps_the_place_and_the_earlier_one_is_told_once(
    machine, place: str, caplog: pytest.LogCaptureFixture
) -> None:
    first = machine("one")
    first.go_on(10, 20)
    second = machine("two")
    second.go_on(30)
    before = content(place)
    first.go_on(30, 40)
    first.mirror.finish(lambda: False)
    assert content(place) == before
    (said,) = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert f"{place} is used by a later start of this run, on 'two', at '20" in said.getMessage()
    second.go_on(40)
    second.mirror.finish(lambda: False)
    assert sorted(complete(RemoteCheckpoints(place).listing()))[-1] == checkpoint_name(40)
    assert storage.read_bytes(f"{place}/checkpoints/{checkpoint_name(40)}/optimizer.pt").startswith(b"two")
    assert len(caplog.records) == 1


def test_two_that_begin_at_once_do_not_both_keep_the_place(
    machine, place: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each saw an empty place; the runs have different names."""
    first, second = machine("one", "this"), machine("two", "that")
    with monkeypatch.context() as at_once:
        at_once.setattr(RemoteCheckpoints, "listing", lambda _: {})
        first.go_on(10)
        second.go_on(10)
    first.go_on(20)
    second.go_on(20)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "continues without it" in caplog.text or "on this machine alone" in caplog.text
    name = f"{place}/checkpoints/{checkpoint_name(20)}/state.json"
    assert json.loads(storage.read_bytes(name))["run_id"] == "that"


@pytest.mark.parametrize("starts", [b"?", b"[]", b'[{"host": 7}]'])
def test_a_list_of_starts_that_tells_nothing_is_another_start_all_the_same(
    machine, place: str, caplog: pytest.LogCaptureFixture, starts: bytes
) -> None:
    first = machine("one")
    first.go_on(10)
    (Path(place) / ENVIRONMENT).write_bytes(starts)
    first.go_on(20)
    assert "used by a later start of this run, elsewhere" in caplog.text


def test_who_removed_the_list_of_starts_took_the_place_from_nobody(machine, place: str, caplog) -> None:
    first = machine("one")
    first.go_on(10)
    (Path(place) / ENVIRONMENT).unlink()
    first.go_on(20)
    assert not caplog.records
    assert (Path(place) / ENVIRONMENT).read_bytes() == (first.folder / ENVIRONMENT).read_bytes()
    assert sorted(complete(RemoteCheckpoints(place).listing())) == [checkpoint_name(10), checkpoint_name(20)]
