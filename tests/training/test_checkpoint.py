"""A checkpoint is whole or is not used."""

import errno
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from vjepa2_ac.config import CheckpointConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.training.checkpoint import (
    CheckpointClock,
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


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_best_stays_besides_the_newest_until_there_is_a_better_one(tmp_path: Path) -> None:
    for step, error in [(10, 0.9), (20, 0.7), (30, 0.8), (40, float("nan")), (50, 0.7)]:
        before = newest_checkpoint(tmp_path)
        state = replace(read_state(before), step=step) if before else RunState(step)
        write_checkpoint(tmp_path, state.measured(error), write_weights, keep=2)
    assert names(tmp_path) == [checkpoint_name(20), checkpoint_name(40), checkpoint_name(50)]
    state = read_state(newest_checkpoint(tmp_path))
    assert (state.best_step, state.best_error) == (20, 0.7)
    write_checkpoint(tmp_path, replace(state, step=60).measured(0.6), write_weights, keep=2)
    assert names(tmp_path) == [checkpoint_name(50), checkpoint_name(60)]


def test_a_best_checkpoint_that_somebody_removed_is_not_waited_for(tmp_path: Path) -> None:
    write_checkpoint(tmp_path, RunState(10).measured(0.5), write_weights, keep=2)
    newest = write_checkpoint(tmp_path, RunState(20, best_step=10, best_error=0.5), write_weights, keep=2)
    shutil.rmtree(tmp_path / checkpoint_name(10))
    assert read_state(newest) == RunState(20)


def test_a_state_from_before_the_best_was_kept_is_still_read(tmp_path: Path) -> None:
    path = write(tmp_path, 20)
    (path / "state.json").write_text('{"step": 20, "broken": {}, "windows": 7}')
    assert read_state(path) == RunState(20, {}, 7)


def test_a_checkpoint_is_due_by_steps_and_by_minutes_since_the_last() -> None:
    now = [0.0]
    clock = CheckpointClock(CheckpointConfig(every=10, every_minutes=2.0), lambda: now[0])
    assert [step for step in range(1, 21) if clock.is_due(step)] == [10, 20]
    now[0] = 119.0
    assert not clock.is_due(3)
    now[0] = 120.0
    assert clock.is_due(3)
    clock.restart()
    assert not clock.is_due(4)
    now[0] = 1e9
    assert not CheckpointClock(CheckpointConfig(every_minutes=None), lambda: now[0]).is_due(1)
