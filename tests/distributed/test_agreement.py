"""The ranks of a run stop at the same step, raise the same errors and share lists of broken episodes."""

from pathlib import Path

import pytest

from paths import ROOT
from ranks import run_ranks
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.runs.checkpoint import newest_checkpoint, read_state

pytestmark = pytest.mark.usefixtures("default_signals")
SCRIPT = str(ROOT / "tests/support/disagreeing_ranks.py")


def run_two_ranks(config: object, tmp_path: Path, fault: str, status: int) -> list[str]:
    """Start two ranks, with a `fault` (a function of the script); return the error output of each."""
    path = tmp_path / "config.yaml"
    path.write_text(config_as_yaml(config))
    return [out for out, _ in run_ranks([SCRIPT, str(path), fault], status=status)]


def test_ranks_with_slightly_different_errors_stop_at_the_same_step(make_config, tmp_path: Path) -> None:
    """Rank 0 measures no improvement and stops after two validations; rank 1 alone would continue."""
    changes = {"training__patience": 2, "checkpoint__keep_best": "error", "validation__every": 1}
    run_two_ranks(make_config(**changes), tmp_path, "measures_otherwise", status=0)
    state = read_state(newest_checkpoint(tmp_path / "run/checkpoints"))
    assert (state.step, state.best_step) == (2, 0)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("disk_is_full", "No space left on device"),
        ("index_cannot_be_made", "no data set"),
        ("encoding_loses_its_connection", "gs://data: no answer"),
    ],
)
def test_error_of_one_rank_is_raised_in_both(make_config, tmp_path: Path, fault: str, message: str) -> None:
    config = make_config(data__cache="auto", data__cache_dir=str(tmp_path / "cache"))
    for output in run_two_ranks(config, tmp_path, fault, status=3):
        assert output.startswith(("InputError: ", "MissingFileError: ", "UnreachableError: "))
        assert message in output


def test_error_in_several_processes_is_printed_once(make_config, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/thesis.tex").write_text("years of work")
    path = tmp_path / "config.yaml"
    path.write_text(config_as_yaml(make_config()))
    output = [err for _, err in run_ranks(["-m", "vjepa2_ac.cli", "train", str(path)], status=2)]
    assert ["a folder with other files" in err for err in output] == [True, False]


def test_limit_of_broken_episodes_applies_to_all_ranks_together(make_config, tmp_path: Path) -> None:
    config = make_config(data__broken_episodes="skip")
    for output in run_two_ranks(config, tmp_path, "each_meets_another_broken_episode", status=3):
        assert "4 of 8 episodes are broken" in output


def test_other_ranks_wait_for_a_slow_index(make_config, tmp_path: Path) -> None:
    run_two_ranks(make_config(training__steps=1), tmp_path, "indexing_takes_longer_than_the_time_out", status=0)
