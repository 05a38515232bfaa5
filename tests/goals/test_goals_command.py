"""`vjepa2-ac goals` makes a goal folder from an episode, and `plan` uses it."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from tiny_models import tiny_model
from vjepa2_ac.api import open_dataset
from vjepa2_ac.cli import main
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset

QUICK = ["planning.samples=8", "planning.iterations=2", "planning.planner.options.elites=4"]
STATE = "0.4,0.0,0.3,3.1,0.0,0.1,0.2"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of two picks, a config and a model."""
    folder = tmp_path_factory.mktemp("folder")
    record_dataset(folder / "set", RecordingSpec("A", 41, seed=3, task="pick"), episodes=2)
    config = {
        "run_dir": str(folder / "run"),
        "data": {"path": str(folder / "set"), "frames": 4},
        "model": {"base": "none"},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    tiny_model().save_pretrained(folder / "model")
    return folder


def goals(folder: Path, out: Path, *options: str, source: str = "config.yaml") -> tuple[int, dict]:
    status = main(["goals", str(folder / source), "--out", str(out), *options])
    return status, json.loads((out / "goals.json").read_text()) if status == 0 else {}


def test_goals_command_selects_gripper_key_frames(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, file = goals(folder, tmp_path / "goals", "--share", "0.5", "--slack", "1")
    assert status == 0
    assert [goal["name"] for goal in file["goals"]] == ["before closing", "closed", "end"]
    assert [goal["gripper"] for goal in file["goals"]] == ["held", "close", "held"]
    assert [goal["frame"] for goal in file["goals"]] == [16, 18, 40]
    assert [(goal["at_least"], goal["at_most"]) for goal in file["goals"]] == [(3, 5), (1, 2), (5, None)]
    assert [goal["share"] for goal in file["goals"]] == [0.5, 0.5, None]
    origin = file["origin"]
    assert (origin["data"], origin["by"], origin["stride"], origin["frames"]) == (
        str(folder / "set"), "gripper", 4, 41,
    )  # fmt: skip
    with Image.open(tmp_path / "goals/goals.png") as sheet:
        assert sheet.width == 1196
    printed = capsys.readouterr().out
    assert "before closing" in printed
    assert str(tmp_path / "goals/goals.json") in printed


def test_goals_command_accepts_name_or_number_and_selects_every_nth_frame(folder: Path, tmp_path: Path) -> None:
    _, selected_by_number = goals(folder, tmp_path / "a", "--episode", "1", "--every", "10", "data.stride=5")
    name = selected_by_number["origin"]["episode"]
    _, selected_by_name = goals(folder, tmp_path / "b", "--episode", name, "--every", "10", "data.stride=5")
    assert selected_by_name["goals"] == selected_by_number["goals"]
    assert [goal["frame"] for goal in selected_by_name["goals"]] == [10, 20, 30, 40]
    assert [goal["at_most"] for goal in selected_by_name["goals"]] == [5, 5, 5, None]
    assert selected_by_name["origin"]["every"] == 10


def test_plan_command_accepts_a_goal_folder(folder: Path, tmp_path: Path) -> None:
    goal_folder, model = tmp_path / "goals", str(folder / "model")
    goals(folder, goal_folder, "--share", "0.5")
    arguments = ["--goals", str(goal_folder), "--state", STATE, "--nodes", "0", "--out", str(tmp_path / "plan"), *QUICK]
    assert main(["plan", model, "--start", str(goal_folder / "goal_3.png"), *arguments]) < 2
    plan = json.loads((tmp_path / "plan/plan.json").read_text())
    assert plan["goals"] == [str(goal_folder)]
    assert [goal["gripper"] for goal in plan["sub_goals"]] == ["held", "close", "held"]
    assert {row[6] for row in plan["actions"]} == {0.0}, "the gripper does not move on the way to the first goal"


def test_invalid_goal_folder_raises_before_planning(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    goal_folder, model = tmp_path / "goals", str(folder / "model")
    goals(folder, goal_folder)
    start = [
        "plan",
        model,
        "--start",
        str(goal_folder / "goal_1.png"),
        "--state",
        STATE,
        "--out",
        str(tmp_path / "plan"),
    ]
    capsys.readouterr()
    assert main([*start, "--goals", str(folder), *QUICK]) == 2
    assert "goals.json: cannot be read" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main([*start, "--goals", str(goal_folder), "--goal", str(goal_folder / "goal_1.png")])
    content = json.loads((goal_folder / "goals.json").read_text())
    content["goals"][0]["at_most"] = None
    (goal_folder / "goals.json").write_text(json.dumps(content))
    capsys.readouterr()
    assert main([*start, "--goals", str(goal_folder), *QUICK]) == 2
    assert "goal 1: a goal without an end" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        (["config.yaml", "--episode", "9"], "--episode 9: 0 episodes with this name"),
        (["config.yaml", "data.stride=auto"], "data.stride: auto"),
    ],
)
def test_goals_command_with_invalid_input_prints_one_error_and_writes_nothing(
    words: list[str], wrong: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, *options = words
    status, _ = goals(folder, tmp_path / "goals", *options, source=source)
    assert status == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert wrong in error
    assert not list(tmp_path.iterdir())


def test_plan_command_reads_its_goal_from_an_episode(whole_run: Path, data_folder: Path, tmp_path: Path) -> None:
    dataset = open_dataset(data_folder, frames=4, stride=2)
    last, third = dataset.source.read(1).read_frames([len(dataset.source.read(1).states) - 1, 3])
    Image.fromarray(third).save(tmp_path / "third.png")
    start = ["--start", str(tmp_path / "third.png"), "--state", STATE, "--nodes", "0", "--out", str(tmp_path)]
    reasons = {}
    for goal in ("1", "1:3", "1:99", "unknown"):
        status = main(["plan", str(whole_run), *QUICK, *start, "--goal-from", goal])
        reasons[goal] = json.loads((tmp_path / "plan.json").read_text())["why"] if status < 2 else None
    assert reasons == {"1": "planned", "1:3": "at the goal", "1:99": None, "unknown": None}
    assert not np.array_equal(last, third)
