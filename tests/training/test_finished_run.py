"""Training a finished run loads nothing and writes only settings that do not affect results."""

import shutil
from pathlib import Path

import pytest

from run_fixtures import MakeConfig, SilentReporter
from same_run import metrics
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.folder import read_run_config
from vjepa2_ac.training import loop
from vjepa2_ac.training.loop import train


class LoadedError(Exception):
    """Raised instead of loading data or a model."""


@pytest.fixture
def run(whole_run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole_run, tmp_path / "run")


@pytest.fixture
def nothing_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(*_: object, **__: object) -> None:
        raise LoadedError

    monkeypatch.setattr(loop, "set_up", load)


def content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != ".lock"}


@pytest.mark.usefixtures("nothing_is_loaded")
def test_train_on_a_finished_run_changes_no_file(make_config: MakeConfig, run: Path, reporter: SilentReporter) -> None:
    before = content(run)
    assert train(make_config(), reporter) == run
    assert reporter.notes == ["Training is finished after 6 steps (training.steps)."]
    assert content(run) == before
    with pytest.raises(LoadedError):
        train(make_config(), reporter, check_only=True)


@pytest.mark.usefixtures("nothing_is_loaded")
def test_finished_run_records_irrelevant_settings_and_uploads_missing_files(
    make_config: MakeConfig, run: Path, reporter: SilentReporter, tmp_path: Path
) -> None:
    config = make_config(checkpoint__remote=str(tmp_path / "mirror"), checkpoint__keep=1)
    train(config, reporter)
    assert read_run_config(run).checkpoint == config.checkpoint
    assert read_run_config(tmp_path / "mirror").checkpoint.keep == 1
    assert (tmp_path / "mirror/checkpoints/step-00000006/manifest.json").is_file()


@pytest.mark.usefixtures("nothing_is_loaded")
@pytest.mark.parametrize(
    "changes",
    [
        {"training__steps": 7},
        {"checkpoint__keep_best": "error"},
        {"data_folder": "elsewhere"},
        {"base_folder": "moved"},
    ],
)
def test_finished_run_starts_again_with_more_steps_or_other_paths(
    make_config: MakeConfig, run: Path, reporter: SilentReporter, changes: dict[str, object]
) -> None:
    with pytest.raises(LoadedError):
        train(make_config(run_dir=run, **changes), reporter, allow_config_change=True)
    if "training__steps" in changes:
        with pytest.raises(InputError, match=r"differs in training\.steps"):
            train(make_config(run_dir=run, **changes), reporter)


def test_extended_run_reports_its_learning_rate(make_config: MakeConfig, run: Path, reporter: SilentReporter) -> None:
    train(make_config(run_dir=run, training__steps=13, validation__every=100), reporter, allow_config_change=True)
    rate_notes = [note for note in reporter.notes if note.startswith("The learning rate")]
    rate = next(row["learning_rate"] for row in metrics(run) if row["kind"] == "train" and row["step"] == 7)
    assert rate == pytest.approx(1e-3 / 2)
    (line,) = rate_notes
    assert line.startswith("The learning rate continues at 5.0e-04 (it had reached 0 at step 6). ")
    assert "training.steps: 6 -> 13" in "".join(reporter.notes)
