"""Relative paths: a run can be evaluated from anywhere, and is resumed only from its own folder."""

import json
import shutil
from pathlib import Path

import pytest

from vjepa2_ac.config.loading import config_as_dict, load_config, parse_config
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.reports.write import evaluate_subject
from vjepa2_ac.runs.folder import start_folders
from vjepa2_ac.runs.loading import load_run
from vjepa2_ac.runs.relative_paths import with_paths_from_start
from vjepa2_ac.training.loop import train

ASKED = EvaluationOptions(clips=4, probes=ProbeOptions(sensitivity_clips=0, landscape_clips=0, examples=0))


@pytest.fixture
def home(tmp_path: Path, data_folder: Path, base_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a data set and a base in it, which is gone to; and one beside it."""
    home = tmp_path / "home"
    home.mkdir()
    (tmp_path / "elsewhere").mkdir()
    shutil.copytree(data_folder, home / "data")
    shutil.copytree(base_folder, home / "base")
    monkeypatch.chdir(home)
    return home


@pytest.fixture
def config(make_config, home: Path):  # type: ignore[no-untyped-def]
    values = config_as_dict(make_config(training__steps=2, data__test_share=0.3))
    values["data"]["path"], values["model"]["base"] = "data", "base"
    return parse_config({**values, "run_dir": "run"}, where=str(home))


def test_a_run_is_measured_from_anywhere_with_the_same_metrics(config, home, reporter, monkeypatch) -> None:
    train(config, reporter)
    as_written = (home / "run/config.yaml").read_text()
    here = evaluate_subject("run", ASKED).evaluation
    monkeypatch.chdir(home.parent / "elsewhere")
    there = evaluate_subject(str(home / "run"), ASKED).evaluation
    elsewhere, at_home = (found.models["adapter"].errors.of("rollout") for found in (there, here))
    assert (elsewhere == at_home).all()
    assert there.clips.episode_ids == here.clips.episode_ids
    assert there.about.data == str(home / "data")
    assert load_run(Path("../home/run")).config.model.base == str(home / "base")
    assert (home / "run/config.yaml").read_text() == as_written
    assert list(Path.cwd().iterdir()) == []


def test_a_run_that_would_go_on_from_elsewhere_names_its_folder_and_goes_on_from_there(
    config, home, reporter, monkeypatch
) -> None:
    train(config, reporter)
    elsewhere = load_config(home / "run/config.yaml", [f"run_dir={home / 'run'}"])
    monkeypatch.chdir(home.parent / "elsewhere")
    with pytest.raises(InputError, match=r"data\.path: data: a relative path") as caught:
        train(elsewhere, reporter)
    assert f"there it is {home / 'data'}" in str(caught.value)
    assert f"vjepa2-ac train {home / 'run'} --resume" in str(caught.value)
    monkeypatch.chdir(home)
    train(elsewhere, reporter)
    assert any("Going on from" in note for note in reporter.notes)
    assert start_folders(home / "run") == [home, home]


@pytest.mark.parametrize(("name", "key"), [("data", "data.path"), ("base", "model.base")])
def test_what_is_nowhere_is_told_from_where_it_was_looked_for(config, home, reporter, monkeypatch, name, key) -> None:
    train(config, reporter)
    shutil.rmtree(home / name)
    monkeypatch.chdir(home.parent / "elsewhere")
    with pytest.raises(InputError, match=rf"{key}: {name}: a relative path") as caught:
        evaluate_subject(str(home / "run"), ASKED)
    assert f"nowhere from {Path.cwd()}, nor from {home}, where the run was started" in str(caught.value)
    assert ("--data CONFIG" in str(caught.value)) == (name == "data")
    note = home / "run/environment.json"
    note.write_text(json.dumps([{**start, "folder": None} for start in json.loads(note.read_text())]))
    with pytest.raises(InputError, match="Go to the folder in which the run was started"):
        evaluate_subject(str(home / "run"), ASKED)


def test_only_paths_that_lead_nowhere_are_looked_for_elsewhere(config, home, reporter, monkeypatch) -> None:
    train(config, reporter)
    (home / "caches").mkdir()
    (home / "ranges.json").write_text("{}")
    elsewhere = home.parent / "elsewhere"
    (elsewhere / "data").mkdir()
    monkeypatch.chdir(elsewhere)
    values = config_as_dict(config)
    values["data"] |= {"cache_dir": "caches", "disk_cache": {"dir": "none"}}
    values["data"]["idle"] |= {"rule": "published", "ranges": "ranges.json"}

    def seen(**changes: object):  # type: ignore[no-untyped-def]
        changed = {**values, "data": {**values["data"], **changes}}
        return with_paths_from_start(parse_config(changed, where=""), home / "run", needed=["data.path"]).data

    found = seen()
    assert (found.path, found.cache_dir, found.disk_cache.dir) == ("data", str(home / "caches"), "none")
    assert found.idle.ranges == str(home / "ranges.json")
    for path in ("gs://bucket/set", "/nowhere/set"):
        assert seen(path=path).path == path
