"""A place that fills up or is closed during a run: one warning, and up to date when it works again."""

import errno
import logging
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import BinaryIO

import pytest

from gcs import Gcs
from vjepa2_ac import storage
from vjepa2_ac.config import CheckpointConfig
from vjepa2_ac.errors import RefusedError, UnreachableError
from vjepa2_ac.runs.checkpoint import RunState, checkpoint_name, write_checkpoint
from vjepa2_ac.runs.mirror.background_sync import Mirror
from vjepa2_ac.runs.mirror.remote_checkpoints import RemoteCheckpoints, complete
from vjepa2_ac.runs.mirror.upload import RemoteUpdate
from vjepa2_ac.storage import transfer

WEIGHTS, MOMENTS = 10_000, 20_000


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yaml").write_text("seed: 0\n")
    return folder


def mirror_of(run: Path, place: str) -> Mirror:
    config = CheckpointConfig(keep=3, remote=place, remote_every_minutes=0.0)
    return Mirror(RemoteUpdate(RemoteCheckpoints(place), run, "mine", config.keep), config)


def go_on(run: Path, mirror: Mirror, *steps: int) -> None:
    """Train, and let each checkpoint be sent."""

    def files(folder: Path) -> None:
        (folder / "adapter.bin").write_bytes(bytes(WEIGHTS))
        (folder / "optimizer.pt").write_bytes(bytes(MOMENTS))

    for step in steps:
        write_checkpoint(run / "checkpoints", RunState(step, run_id="mine"), files, keep=3)
        mirror.tick()
        mirror._thread.join()


def there(place: str) -> list[str]:
    return sorted(complete(RemoteCheckpoints(place).listing()))


def names(*steps: int) -> list[str]:
    return [checkpoint_name(step) for step in steps]


@pytest.mark.parametrize(
    ("status", "match"),
    [(403, "POST /upload/"), (403, "DELETE"), (401, ""), (507, "POST /upl")],
)
def test_a_bucket_that_is_closed_for_a_while_costs_one_warning(
    gcs: Gcs, run: Path, status: int, match: str, caplog: pytest.LogCaptureFixture
) -> None:
    gcs.put("bucket/other", b"1")
    mirror = mirror_of(run, "gs://bucket/run")
    go_on(run, mirror, 10)
    gcs.fail_next(status, times=10_000, match=match)
    go_on(run, mirror, 20, 30)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert str(status) in caplog.text
    assert "Training continues; next attempt in 0 minutes" in caplog.text
    gcs.forget()
    go_on(run, mirror, 40)
    assert there("gs://bucket/run") == (names(20, 30, 40) if match == "DELETE" else names(10, 40))
    mirror.finish(lambda: False)
    assert len(caplog.records) == 1


class Disk:
    """The disk of a place, with room for so many bytes, some of which others take."""

    def __init__(self, folder: Path, room: int) -> None:
        self.folder, self.room, self.of_others = folder, room, 0
        self.code = errno.ENOSPC

    def copyfileobj(self, source: BinaryIO, target: BinaryIO) -> None:
        used = sum(path.stat().st_size for path in self.folder.rglob("*") if path.is_file())
        data = source.read()
        if used + self.of_others + len(data) > self.room:
            raise OSError(self.code, "No room")
        target.write(data)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_place_without_room_may_have_some_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    def full(**_: object) -> None:
        raise OSError(code, "No room")

    monkeypatch.setattr(transfer.tempfile, "TemporaryFile", full)
    with pytest.raises(UnreachableError) as caught:
        storage.try_writing(str(tmp_path))
    assert not isinstance(caught.value, RefusedError), "training begins without it, with a warning"


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_halves_of_a_full_disk_do_not_keep_it_full(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, code: int
) -> None:
    place = tmp_path / "disk"
    disk = Disk(place, room=int(4.2 * (WEIGHTS + MOMENTS)))  # three that are kept, and one that comes
    disk.code = code
    monkeypatch.setattr(transfer, "shutil", SimpleNamespace(copyfileobj=disk.copyfileobj, rmtree=shutil.rmtree))
    mirror = mirror_of(run, str(place))
    go_on(run, mirror, 10, 20, 30, 40)
    disk.of_others = (WEIGHTS + MOMENTS) // 2
    go_on(run, mirror, 50, 60, 70)
    assert there(str(place)) == names(20, 30, 40)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "No room" in caplog.text
    disk.of_others = 0
    go_on(run, mirror, 80)
    assert there(str(place)) == names(30, 40, 80)
    assert len(list((place / "checkpoints").iterdir())) == 3
    assert len(caplog.records) == 1
