"""`init` as a user gives it: a config, the check of the data, and what to do next."""

from pathlib import Path

import pytest

from copied_sets import write_npz
from vjepa2_ac.cli import main
from vjepa2_ac.config.loading import load_config


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_npz(tmp_path / "data/my robot/v1.0", range(20))
    return tmp_path


def test_a_config_for_the_data_that_are_there(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", "data/my robot/v1.0", "--model", "builtin:sim-tiny"]) == 0
    told = capsys.readouterr().out
    config = load_config(here / "my-robot.yaml")
    assert (config.data.path, config.run_dir) == ("data/my robot/v1.0", "runs/my-robot")
    assert "Data: .npz, 20 episodes at 15 a second" in told
    assert "$ vjepa2-ac data check my-robot.yaml" in told
    assert told.count("ok  ") > 10
    next_commands = told.partition("Next:")[2]
    for words in ("train my-robot.yaml --check", "training.steps=100", "evaluate runs/my-robot-trial", "real run"):
        assert words in next_commands, words
    assert main(["train", "my-robot.yaml", "--check"]) == 0


def test_a_config_that_is_there_stays(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "mine.yaml").write_text("precious")
    words = ["init", "data/my robot/v1.0", "--model", "builtin:sim-tiny", "--out", "mine.yaml"]
    assert main(words) == 2
    assert (here / "mine.yaml").read_text() == "precious"
    assert "--overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    assert load_config(here / "mine.yaml").data.source == "npz"


def test_data_that_cannot_be_trained_on_give_a_config_all_the_same_and_status_2(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(2, 20):
        (here / f"data/my robot/v1.0/{number:03d}.npz").unlink()
    assert main(["init", "data/my robot/v1.0", "--model", "builtin:sim-tiny"]) in {1, 2}
    told = capsys.readouterr()
    assert "episodes among 2" in told.out + told.err
    assert "Fix these errors first, then: vjepa2-ac data check my-robot.yaml\n\nNext:" in told.out
    assert load_config(here / "my-robot.yaml").data.validation_share == 0.15


@pytest.mark.parametrize("name", ["sim", "scratch-sim"])
def test_simulated_data_are_recorded_first(name: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", "sim", *["--scratch"] * (name != "sim")]) == 0
    assert "vjepa2-ac simulate record demo/data" in capsys.readouterr().out
    config = load_config(here / f"{name}.yaml")
    assert config.data.path == "demo/data"
    assert (config.model.encoder is not None) == (name != "sim")


@pytest.mark.usefixtures("here")
def test_the_released_model_is_to_be_fetched_first(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", "data/my robot/v1.0", "--out", "sub/a.yaml"]) == 0
    told = capsys.readouterr().out
    assert "vjepa2-ac download   # the model, once: 11.7 GB" in told
    assert "# the real run, 200 times the trial's step time; repeat to resume" in told
    assert load_config("sub/a.yaml").model.base == "checkpoints/vjepa2-ac-vitg.pt"
