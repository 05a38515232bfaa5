"""The data commands: output, files and exit status."""

import json
from pathlib import Path

import pytest
import yaml

from synthetic import write_synthetic_droid
from vjepa2_ac.cli import main


@pytest.fixture(scope="module")
def droid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic_droid(tmp_path_factory.mktemp("set") / "1.0.0", episodes=8, steps=40, size=(36, 64))


@pytest.fixture
def config(droid: Path, tmp_path: Path) -> str:
    values = {
        "run_dir": str(tmp_path / "run"),
        "data": {
            "path": str(droid), "frames": 3, "stride": 4, "validation_share": 0.4, "test_share": 0.0, "workers": 0,
            "disk_cache": {"dir": str(tmp_path / "cache")},
        },
        "model": {"base": "builtin:sim-tiny", "dtype": "float32"},
        "training": {"precision": "fp32", "device": "cpu", "batch_size": 2},
    }  # fmt: skip
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(values))
    return str(path)


Printed = pytest.CaptureFixture[str]
LEVELS = ("ok", "warning", "error", "skipped")


def test_check_prints_one_line_per_finding_and_returns_0(config: str, capsys: Printed) -> None:
    assert main(["data", "check", config, "--limit", "4"]) == 0
    *lines, summary = capsys.readouterr().out.splitlines()
    findings = [line.split()[:2] for line in lines if line.startswith(LEVELS)]
    assert [about for _, about in findings[:2]] == ["source", "index"]
    assert {"train", "validation", "batch", "pixels", "position", "rotation", "gripper", "actions", "timing"} <= {
        about for _, about in findings
    }
    counts = {level: sum(printed_level == level for printed_level, _ in findings) for level in LEVELS}
    assert (
        summary == f"0 errors, {counts['warning']} warning{'s' * (counts['warning'] != 1)}, {counts['skipped']} skipped"
    )


@pytest.mark.parametrize("words", [[], ["--model", "builtin:sim-tiny"]], ids=["data", "with a model"])
def test_check_with_json_prints_one_object_with_the_same_findings(
    config: str, capsys: Printed, words: list[str]
) -> None:
    assert main(["data", "check", config, "--limit", "4", *words]) == 0
    text = capsys.readouterr().out
    lines, one_line = [line for line in text.splitlines() if line.startswith(LEVELS)], " ".join(text.split())
    assert main(["data", "check", config, "--limit", "4", "--json", *words]) == 0
    printed = json.loads(capsys.readouterr().out)
    findings = [f"{finding['level']} {finding['name']} {finding['text']}" for finding in printed["findings"]]
    assert len(findings) == len(lines)
    assert not [text for text in findings if text not in one_line and " s" not in text], "only times differ"
    levels = [finding["level"] for finding in printed["findings"]]
    assert [printed[name] for name in ("errors", "warnings", "skipped")] == [
        levels.count(level) for level in ("error", "warning", "skipped")
    ]
    assert bool(printed["variants"]) == bool(words)
    if words:
        assert printed["variants"][0]["name"] == "unchanged"
        assert {"value", "low", "high"} == printed["variants"][1]["difference"].keys()


def test_check_with_json_prints_nothing_to_stdout_if_the_data_cannot_be_read(config: str, capsys: Printed) -> None:
    assert main(["data", "check", config, "--json", "data.camera=elsewhere"]) == 2
    assert capsys.readouterr().out == ""
    assert main(["data", "check", config, "--json", "--limit", "2", "data.validation_share=0"]) == 1
    assert json.loads(capsys.readouterr().out)["errors"] == 1


COMMANDS = ["data check", "data inspect", "data calibrate", "train", "encode", "decoder", "doctor"]


@pytest.mark.parametrize("command", COMMANDS)
def test_folder_instead_of_a_config_raises_with_the_init_command(command: str, droid: Path, capsys: Printed) -> None:
    assert main([*command.split(), str(droid)]) == 2
    assert f"`vjepa2-ac init {droid}`" in capsys.readouterr().err


def test_url_or_run_instead_of_a_config_raises_with_the_fix(config: str, tmp_path: Path, capsys: Printed) -> None:
    with pytest.raises(SystemExit):
        main(["data", "check", "gs://robots/set"])
    assert "`vjepa2-ac init gs://robots/set`" in capsys.readouterr().err
    assert main(["data", "check", str(tmp_path)]) == 2
    assert f"The config of the run in it is {config}" in capsys.readouterr().err


def test_check_returns_1_if_training_would_fail(config: str, capsys: Printed) -> None:
    assert main(["data", "check", config, "data.validation_share=0", "--limit", "2"]) == 1
    assert "error    validation" in capsys.readouterr().out


def test_unwritable_output_folder_raises_before_data_are_read(config: str, tmp_path: Path, capsys: Printed) -> None:
    (tmp_path / "file").write_text("")
    assert main(["data", "inspect", config, "--out", str(tmp_path / "file" / "in it")]) == 2
    assert "--out" in capsys.readouterr().err


def test_inspect_prints_and_writes_statistics_and_a_contact_sheet(config: str, tmp_path: Path, capsys: Printed) -> None:
    out = tmp_path / "out"
    words = ["data.stride=auto", "--out", str(out), "--limit", "4", "--rows", "1"]
    assert main(["data", "inspect", config, *words]) == 0
    printed = capsys.readouterr().out
    for text in ("episodes", "idle", "wrist_left", "candidate, 4"):
        assert text in printed
    values = json.loads((out / "inspect.json").read_text())
    assert (values["episodes"], values["sampled_episodes"]) == (8, 4)
    assert (out / "contact_sheet.png").read_bytes().startswith(b"\x89PNG")


def test_convert_writes_a_data_set_that_can_be_checked(config: str, tmp_path: Path, capsys: Printed) -> None:
    out = tmp_path / "as_lerobot"
    assert main(["data", "convert", config, str(out), "data.camera=wrist_left", 'data.idle={"rule": "motion"}']) == 0
    printed = capsys.readouterr().out
    assert "writing episodes 8/8" in printed
    assert f"8 episodes, 320 steps. Next: vjepa2-ac init {out}" in " ".join(printed.split())
    keys = ["data.source=lerobot", f"data.path={out}", "data.lerobot.state=[observation.state]"]
    keys += ["data.lerobot.cameras={wrist_left: observation.images.wrist_left}", "data.camera=wrist_left"]
    assert main(["data", "check", config, *keys, "--limit", "4"]) == 0
    for folder in (out, tmp_path):
        assert main(["data", "convert", config, str(folder)]) == 2
        assert "the folder exists and is not empty" in capsys.readouterr().err


def test_calibrate_prints_a_table_and_writes_its_metrics(config: str, tmp_path: Path, capsys: Printed) -> None:
    out = tmp_path / "out"
    arguments = ["data", "calibrate", config, "data.stride=auto", "--out", str(out), "--limit", "4"]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert "Best stride" in printed
    calibration = json.loads((out / "calibration.json").read_text())
    assert [row["stride"] for row in calibration["strides"]] == [4, 8, 15]
    assert calibration["stride"] in {4, 8, 15}
    assert {row["clips"] for row in calibration["strides"]} == {4}


def test_axes_of_an_unknown_robot_are_written_but_unusable_for_planning(
    config: str, tmp_path: Path, capsys: Printed
) -> None:
    """The model was not trained on the synthetic robot, so no rotation of its axes is useful."""
    out = tmp_path / "out"
    arguments = ["data", "calibrate", config, "--axes", "builtin:sim-tiny", "--limit", "12", "--out", str(out)]
    assert main(arguments) == 1
    printed = capsys.readouterr().out
    assert "Not usable for planning: " in printed
    axes = json.loads((out / "axes.json").read_text())
    assert axes["pairs"] == 12
    assert axes["problem"] in " ".join(printed.split())
    assert axes["model"]["subject"] == "builtin:sim-tiny"
    capsys.readouterr()
    assert main(["plan", "builtin:sim-tiny", f"planning.axes={out / 'axes.json'}", "--start", "a.png", "--goal",
                 "a.png", "--state", "0.4,0,.3,3,0,0,0"]) == 2  # fmt: skip
    assert axes["problem"][:12] in capsys.readouterr().err
