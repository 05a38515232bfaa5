"""A sweep trains one run for each trial of Optuna, and resumes where it stopped."""

import os
import runpy
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from installing import install
from paths import ROOT
from run_fixtures import as_yaml
from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.runs.checkpoint import newest_checkpoint, parse_step, read_state, select_checkpoint
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.training import loop

pytestmark = pytest.mark.usefixtures("default_signals")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install Optuna without database libraries, which a study in a file does not need."""
    folder = tmp_path_factory.mktemp("site")
    install(sys.executable, "--no-deps", "--target", str(folder), "optuna==5.0.0", "colorlog", "tqdm", "packaging")
    return folder


@pytest.fixture
def sweep(site: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    monkeypatch.syspath_prepend(site)
    main: Callable[..., None] = runpy.run_path(str(ROOT / "examples/sweeps/optuna_sweep.py"))["main"]
    return main


@pytest.fixture
def config(make_config, tmp_path: Path) -> str:
    file = tmp_path / "config.yaml"
    file.write_text(as_yaml(make_config(training__steps=4, validation__every=2)))
    return str(file)


def trials(main: Callable[..., None], folder: Path) -> list[Any]:
    optuna, names = main.__globals__["optuna"], main.__globals__
    storage = names["JournalStorage"](names["JournalFileBackend"](str(folder / "study.journal")))
    study_trials: list[Any] = optuna.load_study(study_name=None, storage=storage).trials
    return study_trials


def test_stopped_sweep_resumes_with_the_open_trial(
    sweep: Callable[..., None], config: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    folder, step_of_the_loop, step_folders = tmp_path / "sweep", loop.training_step, []

    def stopping(run: Any, *args: Any, **kwargs: Any) -> Any:
        step_folders.append(run.folder.name)
        if step_folders == ["000"] * 4 + ["001"] * 2:
            os.kill(os.getpid(), signal.SIGUSR1)
        return step_of_the_loop(run, *args, **kwargs)

    monkeypatch.setattr(loop, "training_step", stopping)
    with pytest.raises(SystemExit, match="75"):
        sweep(str(folder), "3", config)
    assert read_state(newest_checkpoint(folder / "001/checkpoints")).step == 2
    sweep(str(folder), "3", config)
    assert step_folders == ["000"] * 4 + ["001"] * 4 + ["002"] * 4, "no step is done twice"
    completed = trials(sweep, folder)
    assert [trial.state.name for trial in completed] == ["COMPLETE"] * 3
    assert len({str(trial.params) for trial in completed}) == 3
    runs = [folder / f"{trial.number:03}" for trial in completed]
    for run, trial in zip(runs, completed, strict=True):
        selected = parse_step(select_checkpoint(run).path.name)
        rows = [row for row in read_metrics_log(run / "metrics.jsonl") if row["kind"] == "validation"]
        assert trial.value == next(row["action_ranking_error"] for row in rows if row["step"] == selected)
    assert f"in {min(zip(completed, runs, strict=True), key=lambda pair: pair[0].value)[1]}" in capsys.readouterr().out


def test_sweep_continues_after_a_trial_with_an_invalid_config(
    sweep: Callable[..., None], config: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    space = {"adapter.rank": sweep.__globals__["CategoricalDistribution"]([0])}
    monkeypatch.setitem(sweep.__globals__, "SPACE", space)
    with pytest.raises(ValueError, match="No trials are completed"):
        sweep(str(tmp_path / "sweep"), "2", config)
    assert [trial.state.name for trial in trials(sweep, tmp_path / "sweep")] == ["FAIL", "FAIL"]


def test_outage_stops_the_sweep_and_keeps_its_trial_open(
    sweep: Callable[..., None], config: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "training_step", Mock(side_effect=UnreachableError(where="gs://data", found="no answer")))
    with pytest.raises(UnreachableError):
        sweep(str(tmp_path / "sweep"), "2", config)
    assert [trial.state.name for trial in trials(sweep, tmp_path / "sweep")] == ["RUNNING"]


def test_invalid_config_starts_no_trial(sweep: Callable[..., None], config: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="2"):
        sweep(str(tmp_path / "sweep"), "2", config, "training.stepz=3")
    assert [path.name for path in (tmp_path / "sweep").iterdir()] == []
