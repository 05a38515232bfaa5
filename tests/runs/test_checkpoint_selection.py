"""Checkpoint selection: the requested one, or an error that lists the existing ones."""

from pathlib import Path

import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import RunState, write_checkpoint
from vjepa2_ac.runs.checkpoint_selection import select_checkpoint


def write(run: Path, step: int, best_step: int | None = None) -> Path:
    def weights(folder: Path) -> None:
        (folder / "weights").write_bytes(b"weights")

    state = RunState(step, best_step=best_step, best_error=None if best_step is None else 0.5)
    return write_checkpoint(run / "checkpoints", state, weights, keep=9)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run that was best at step 20, and is at step 30."""
    for step, best in [(10, 10), (20, 20), (30, 20)]:
        write(tmp_path, step, best)
    return tmp_path


@pytest.mark.parametrize(
    ("by", "words"),
    [
        ("newest", "step-00000030 (the newest)"),
        ("selected", "step-00000020 (the best by error)"),
        ("best", "step-00000020 (the best by error)"),
        ("10", "step-00000010 (as asked for)"),
    ],
)
def test_the_newest_the_best_and_that_of_a_step_are_found(run: Path, by: str, words: str) -> None:
    chosen = select_checkpoint(run, by)
    assert str(chosen) == words
    assert chosen.path == run / "checkpoints" / words.split(maxsplit=1)[0]


@pytest.mark.parametrize(
    ("by", "found"),
    [
        ("15", "no checkpoint of step 15"),
        ("bset", "--checkpoint bset"),
        ("-10", "--checkpoint -10"),
        ("9" * 5000, "--checkpoint 999"),
    ],
)
def test_one_that_is_not_there_is_an_error_that_names_those_that_are(run: Path, by: str, found: str) -> None:
    with pytest.raises(
        InputError, match=rf"checkpoints: {found}.*\. needed: selected, newest, best or one of the steps 10, 20, 30"
    ):
        select_checkpoint(run, by)


def test_a_damaged_one_is_not_used_in_place_of_what_was_asked_for(run: Path) -> None:
    (run / "checkpoints/step-00000020/weights").write_bytes(b"weighTs")
    for by in ("best", "20"):
        with pytest.raises(InputError, match=r"step-00000020 is damaged: weights is damaged.*one of the steps 10, 30"):
            select_checkpoint(run, by)


def test_a_base_that_is_better_than_all_is_selected_and_called_so(tmp_path: Path) -> None:
    folder = tmp_path / "checkpoints"
    for step in (0, 10):
        state = RunState(step, best_step=0, best_error=0.9, best_rank=0.03)
        write_checkpoint(folder, state, lambda inner: (inner / "weights").touch(), keep=9)
    assert str(select_checkpoint(tmp_path)) == (
        "step-00000000 (the base: none of its checkpoints is better by action ranking)"
    )


def test_without_validations_there_is_no_best(tmp_path: Path) -> None:
    write(tmp_path, 10)
    assert str(select_checkpoint(tmp_path)) == "step-00000010 (the newest: none was selected)"
    with pytest.raises(InputError, match=r"no best checkpoint.*one of the steps 10"):
        select_checkpoint(tmp_path, "best")


def test_a_run_without_checkpoints_is_told_to_train_on(tmp_path: Path) -> None:
    for by in ("newest", "best", "10"):
        with pytest.raises(InputError, match=r"without a whole checkpoint.*--resume"):
            select_checkpoint(tmp_path, by)
