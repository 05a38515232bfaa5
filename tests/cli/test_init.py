"""The command `init` writes a config, checks the data and prints the next commands."""

from pathlib import Path

import numpy as np
import pytest

from copied_sets import write_npz
from vjepa2_ac.cli import main
from vjepa2_ac.config.loading import load_config


@pytest.fixture
def working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_npz(tmp_path / "data/my robot/v1.0", range(20))
    return tmp_path


def test_init_writes_a_config_checks_the_data_and_prints_the_next_commands(
    working_directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["init", "data/my robot/v1.0", "--model", "builtin:sim-tiny"]) == 0
    printed = capsys.readouterr().out
    config = load_config(working_directory / "my-robot.yaml")
    assert (config.data.path, config.run_dir) == ("data/my robot/v1.0", "runs/my-robot")
    assert "Data: .npz files, 20 episodes, 15 control steps per second" in printed
    assert "$ vjepa2-ac data check my-robot.yaml" in printed
    assert printed.count("ok  ") > 10
    next_commands = printed.partition("Next:")[2]
    for command in ("train my-robot.yaml --check", "training.steps=100", "evaluate runs/my-robot-trial", "full run"):
        assert command in next_commands, command
    assert main(["train", "my-robot.yaml", "--check"]) == 0


def test_init_replaces_an_existing_config_only_with_overwrite(
    working_directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (working_directory / "mine.yaml").write_text("precious")
    arguments = ["init", "data/my robot/v1.0", "--model", "builtin:sim-tiny", "--out", "mine.yaml"]
    assert main(arguments) == 2
    assert (working_directory / "mine.yaml").read_text() == "precious"
    assert "--overwrite" in capsys.readouterr().err
    assert main([*arguments, "--overwrite"]) == 0
    assert load_config(working_directory / "mine.yaml").data.source == "npz"


def test_init_with_unusable_data_writes_the_config_and_prints_no_training_commands(
    working_directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(2, 20):
        (working_directory / f"data/my robot/v1.0/{number:03d}.npz").unlink()
    assert main(["init", "data/my robot/v1.0", "--model", "builtin:sim-tiny"]) in {1, 2}
    printed = capsys.readouterr()
    assert "episodes among 2" in printed.out + printed.err
    assert "Fix these errors and run `vjepa2-ac data check my-robot.yaml` again." in printed.out
    assert "Next:" not in printed.out
    assert "training.steps" not in printed.out
    assert load_config(working_directory / "my-robot.yaml").data.validation_share == 0.15


@pytest.mark.parametrize("name", ["sim", "scratch-sim"])
def test_init_sim_prints_the_command_that_records_the_data(
    name: str, working_directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["init", "sim", *["--scratch"] * (name != "sim")]) == 0
    assert "vjepa2-ac simulate record demo/data" in capsys.readouterr().out
    config = load_config(working_directory / f"{name}.yaml")
    assert config.data.path == "demo/data"
    assert (config.model.encoder is not None) == (name != "sim")


@pytest.mark.usefixtures("working_directory")
def test_init_prints_the_download_of_a_missing_model(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", "data/my robot/v1.0", "--out", "sub/a.yaml"]) == 0
    printed = capsys.readouterr().out
    assert "vjepa2-ac download   # downloads the model (11.7 GB)" in printed
    assert "# full run of 200 steps; run again to resume" in printed
    assert load_config("sub/a.yaml").model.base == "checkpoints/vjepa2-ac-vitg.pt"


def test_init_warns_about_a_data_set_with_a_wrist_camera_only(
    working_directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = working_directory / "data/hand/000.npz"
    path.parent.mkdir()
    with np.load(working_directory / "data/my robot/v1.0/000.npz") as episode:
        np.savez(path, states=episode["states"], wrist=episode["frames"], fps_hz=15.0)
    main(["init", "data/hand", "--model", "builtin:sim-tiny"])
    printed = capsys.readouterr().out.partition("$ vjepa2-ac data check")[0]
    assert "Warning: data.camera: wrist seems to be a camera on the hand" in printed
