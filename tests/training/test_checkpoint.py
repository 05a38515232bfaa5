"""A checkpoint is whole or is not used."""

import errno
import logging
from pathlib import Path

import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.training.checkpoint import (
    RunState,
    checkpoint_name,
    damage,
    newest_checkpoint,
    read_state,
    write_checkpoint,
)


def write_weights(folder: Path) -> None:
    (folder / "adapter").mkdir()
    (folder / "adapter" / "weights.bin").write_bytes(b"weights" * 1000)
    (folder / "optimizer.pt").write_bytes(b"moments" * 1000)


def write(folder: Path, step: int, keep: int = 5) -> Path:
    return write_checkpoint(folder, RunState(step), write_weights, keep=keep)


def test_what_is_written_is_found_again(tmp_path: Path) -> None:
    path = write(tmp_path, 20)
    assert newest_checkpoint(tmp_path) == path
    assert read_state(path) == RunState(20)
    assert damage(path) is None


def test_a_folder_without_checkpoints_has_none(tmp_path: Path) -> None:
    assert newest_checkpoint(tmp_path) is None
    assert newest_checkpoint(tmp_path / "missing") is None


def test_only_the_newest_are_kept(tmp_path: Path) -> None:
    for step in (10, 20, 30, 100, 110):
        write(tmp_path, step, keep=2)
    assert sorted(path.name for path in tmp_path.iterdir()) == [checkpoint_name(100), checkpoint_name(110)]


@pytest.mark.parametrize("name", ["adapter/weights.bin", "optimizer.pt", "state.json", "manifest.json"])
@pytest.mark.parametrize("fault", ["truncate", "flip", "remove"])
def test_a_damaged_checkpoint_is_passed_over_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, fault: str
) -> None:
    older, newer = write(tmp_path, 10), write(tmp_path, 20)
    victim = newer / name
    content = bytearray(victim.read_bytes())
    if fault == "truncate":
        victim.write_bytes(content[: len(content) // 2])
    elif fault == "flip":
        content[len(content) // 2] ^= 0x10
        victim.write_bytes(content)
    else:
        victim.unlink()
    with caplog.at_level(logging.WARNING):
        assert newest_checkpoint(tmp_path) == older
    assert str(newer) in caplog.text


def test_a_full_disk_leaves_the_older_checkpoints_and_no_debris(tmp_path: Path) -> None:
    older = write(tmp_path, 10)

    def disk_is_full(folder: Path) -> None:
        (folder / "half").write_bytes(b"x")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(InputError, match="No space left"):
        write_checkpoint(tmp_path, RunState(step=20), disk_is_full, keep=1)
    assert list(tmp_path.iterdir()) == [older]
    assert damage(older) is None


def test_what_a_killed_writer_left_behind_is_never_resumed_from_and_is_cleaned_up(tmp_path: Path) -> None:
    debris = tmp_path / f".writing-{checkpoint_name(30)}"
    debris.mkdir()
    write_weights(debris)
    assert newest_checkpoint(tmp_path) is None
    path = write(tmp_path, 40)
    assert list(tmp_path.iterdir()) == [path]


def test_when_every_checkpoint_is_damaged_the_run_stops_and_leaves_them(tmp_path: Path) -> None:
    for step in (10, 20):
        (write(tmp_path, step) / "optimizer.pt").write_bytes(b"")
    with pytest.raises(InputError, match="none of 2 checkpoints is whole"):
        newest_checkpoint(tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_new_checkpoint_replaces_the_damaged_ones_after_it(tmp_path: Path) -> None:
    older = write(tmp_path, 10, keep=1)
    for step in (20, 30, 40):
        (write(tmp_path, step, keep=9) / "optimizer.pt").write_bytes(b"")
    path = write(tmp_path, 20, keep=2)
    assert sorted(tmp_path.iterdir()) == [older, path]
    assert newest_checkpoint(tmp_path) == path
