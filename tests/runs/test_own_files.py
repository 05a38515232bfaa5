"""Own files: a run writes into its own folder only, despite links; foreign names are no checkpoints."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.runs import folder
from vjepa2_ac.runs.checkpoint import RunState, listed, newest_checkpoint, remove_leavings, write_checkpoint
from vjepa2_ac.runs.folder import check_run_folder
from vjepa2_ac.runs.lock import RunLock
from vjepa2_ac.runs.manifest import write_manifest
from vjepa2_ac.runs.own_files import refuse_links_out
from vjepa2_ac.training.loop import train

FOLDERS = {folder.CHECKPOINTS, folder.HELD, folder.TENSORBOARD, folder.WANDB, folder.NOT_FINITE}


@pytest.fixture
def precious(tmp_path: Path) -> Path:
    """Something of the user's that is not the run's."""
    path = tmp_path / "precious"
    path.mkdir()
    (path / "file").write_text("years of work")
    return path


@pytest.mark.parametrize("name", folder._OWN)
def test_a_link_that_leads_out_of_a_run_is_refused_before_anything_is_written(
    make_config: Callable[..., Any], reporter: Any, precious: Path, name: str
) -> None:
    config = make_config(training__steps=1)
    run = Path(config.run_dir)
    run.mkdir()
    target = precious if name in FOLDERS else precious / "file"
    (run / name).symlink_to(target)
    for attempt in (lambda: check_run_folder(config), lambda: train(config, reporter)):
        with pytest.raises(InputError, match=f"{name}: a link that leads out of the run, to {target}"):
            attempt()
    assert [path.name for path in precious.iterdir()] == ["file"]
    assert (precious / "file").read_text() == "years of work"


def test_the_lock_itself_is_never_taken_through_a_link(tmp_path: Path, precious: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".lock").symlink_to(precious / "file")
    with RunLock(tmp_path / "run") as lock, pytest.raises(InputError, match="a link that leads out"):
        lock.take()
    assert (precious / "file").read_text() == "years of work"


def test_links_within_a_run_and_a_run_that_is_a_link_itself_are_fine(tmp_path: Path) -> None:
    home = tmp_path / "home"
    (home / "other").mkdir(parents=True)
    (home / "checkpoints").symlink_to("other")
    (tmp_path / "run").symlink_to(home)
    refuse_links_out(tmp_path / "run", ["checkpoints", "config.yaml"])
    (home / "tensorboard").symlink_to("tensorboard")  # a circle
    with pytest.raises(InputError, match="a link that leads nowhere"):
        refuse_links_out(tmp_path / "run", ["tensorboard"])


def written(folder: Path, *steps: int) -> list[Path]:
    def weights(path: Path) -> None:
        (path / "weights").write_bytes(b"weights")

    return [write_checkpoint(folder, RunState(step, clips_done=step), weights, keep=9) for step in steps]


@pytest.mark.parametrize("name", ["step-00000020.bak", "step-00000020 copy", "step-20", "step-000000020", "last"])
def test_a_copy_under_a_name_of_ones_own_is_no_checkpoint_and_stays(tmp_path: Path, name: str) -> None:
    ten, twenty = written(tmp_path, 10, 20)
    shutil.copytree(twenty, tmp_path / name)
    assert listed(tmp_path) == [ten, twenty]
    assert newest_checkpoint(tmp_path) == twenty
    write_checkpoint(tmp_path, RunState(30, clips_done=30), lambda _: None, keep=1)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([name, "step-00000030"])


def test_a_copy_under_the_name_of_another_step_is_damaged_and_passed_over(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _, twenty = written(tmp_path, 10, 20)
    shutil.copytree(twenty, tmp_path / "step-00000099")
    assert newest_checkpoint(tmp_path) == twenty
    assert "step-00000099: a copy of another one, of step 20; passed over" in caplog.text


@pytest.mark.parametrize("step", [None, "20", {"a": 1}, [20], 20.0, True])
def test_a_step_that_is_none_is_damage(tmp_path: Path, caplog: pytest.LogCaptureFixture, step: object) -> None:
    ten, twenty = written(tmp_path, 10, 20)
    (twenty / "state.json").write_text(json.dumps({"step": step, "clips_done": 20}))
    (twenty / "manifest.json").unlink()
    write_manifest(twenty)
    assert newest_checkpoint(tmp_path) == ten
    assert "step-00000020: no readable state.json (step: " in caplog.text


def test_checkpoints_beyond_eight_digits_are_the_newest(tmp_path: Path) -> None:
    old, new = written(tmp_path, 99_999_999, 100_000_000)
    assert (listed(tmp_path), newest_checkpoint(tmp_path)) == ([old, new], new)


def test_halves_that_a_kill_left_go_and_what_is_somebody_elses_stays(tmp_path: Path) -> None:
    for name in (".writing-step-00000030", ".fetching-step-00000040", ".writing-notes", "mine"):
        (tmp_path / name).mkdir()
    remove_leavings(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".writing-notes", "mine"]


def test_a_run_with_a_copy_among_its_checkpoints_goes_on(make_config: Callable[..., Any], reporter: Any) -> None:
    config = make_config(training__steps=2, checkpoint__every=1)
    train(config, reporter)
    checkpoints = Path(config.run_dir) / "checkpoints"
    shutil.copytree(checkpoints / "step-00000002", checkpoints / "step-00000002.bak")
    train(make_config(training__steps=3, checkpoint__every=1), reporter, allow_config_change=True)
    assert (checkpoints / "step-00000003").is_dir()
    assert (checkpoints / "step-00000002.bak").is_dir()
