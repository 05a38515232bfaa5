"""The closed-loop benchmark: table, metrics and video agree."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from tiny_models import tiny_model, vector_model
from vjepa2_ac.cli import main
from vjepa2_ac.media.video import read_header
from vjepa2_ac.planning.model_setup import load_for_planning
from vjepa2_ac.simulation.benchmark import JOINT_FIELDS, VIDEO_FILE, BenchmarkOptions, run_benchmark, video_frames
from vjepa2_ac.storage.paths import CLOSED_LOOP_FILE

SMALL = [
    "planning.samples=6",
    "planning.iterations=2",
    "planning.planner.options.elites=3",
    "planning.limits.xyz=[0.03,0.03,0.03]",
]
TWICE = ["--episodes", "2", "--steps", "2", "--films", "1"]


@pytest.fixture(scope="module")
def joint_model(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Return a model of seven joint angles and a gripper, and a config that says so."""
    folder = tmp_path_factory.mktemp("joints")
    vector_model(8).save_pretrained(folder / "model")
    data = {"path": "none", "states": "vector", "fields": {"state": list(JOINT_FIELDS)}}
    config = {"run_dir": "none", "data": data, "model": {"base": "none", "dtype": "float32"}}
    (folder / "joints.yaml").write_text(yaml.safe_dump(config))
    return str(folder / "model"), folder / "joints.yaml"


def test_joint_model_acts_in_joint_space(
    joint_model: tuple[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, config = joint_model
    arguments = ["simulate", model, "--config", str(config), "--domain", "B", *TWICE, "--out", str(tmp_path), *SMALL]
    assert main([*arguments, "planning.limits.axes=[0.2]"]) == 0
    assert metrics(tmp_path)["policies"]["model"]["why_counts"] == {"planned": 4}
    distances = np.array(metrics(tmp_path)["policies"]["model"]["by_episode"]["distance_cm"])
    assert (np.abs(np.diff(distances, axis=1)) > 0.1).all(), "the arm moves"
    capsys.readouterr()
    assert main(arguments) == 2
    assert "planning.limits.axes: data, but the model has no record" in capsys.readouterr().err
    (tmp_path / "other.yaml").write_text(config.read_text().replace("joint_position", "other"))
    assert main([*arguments, "--config", str(tmp_path / "other.yaml"), "planning.limits.axes=[0.2]"]) == 2
    assert "states that the simulated arm does not measure" in capsys.readouterr().err


def test_video_shows_images_and_goal(model: str) -> None:
    options = BenchmarkOptions(episodes=2, steps=2, films=1)
    result = run_benchmark(load_for_planning(model, overrides=SMALL), options).results[0]
    filmed, other = result.episodes
    assert other.frames is None
    frames = list(video_frames(result))
    assert frames[0].shape[1] == 640
    for frame, image in ((frames[0], filmed.frames[0]), (frames[-1], filmed.frames[-1])):
        np.testing.assert_array_equal(frame[60:420:2, :640:2], image)
        np.testing.assert_array_equal(frame[-180:, :320], filmed.goal_image)


def metrics(folder: Path) -> dict:
    return json.loads((folder / CLOSED_LOOP_FILE).read_text())


def test_simulate_prints_each_policy_and_writes_json_and_video(
    model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["simulate", model, "--task", "reach", "--domain", "B", *TWICE, "--all", "--out", str(tmp_path), *SMALL])
        == 0
    )
    shown = capsys.readouterr().out
    rows = {line.split("│")[1].strip(): line for line in shown.splitlines() if line.startswith("│")}
    assert list(rows) == ["tiny", "zero action", "random", "oracle"]
    assert "reach in domain B: 2 problems of seed 0, 2 steps of 0.27 s" in shown
    assert "The oracle solves only 0.0 % of these problems, so they cannot be used for" in shown
    reported = metrics(tmp_path)
    assert list(reported["policies"]) == list(rows)
    assert reported["verdict"]["conclusion"] == "inconclusive"
    assert reported["about"]["planning"]["samples"] == 6
    for name, policy in reported["policies"].items():
        distances = np.array(policy["by_episode"]["distance_cm"])
        assert distances.shape == (2, 3)
        assert policy["final_distance_cm"]["value"] == pytest.approx(distances[:, -1].mean(), abs=1e-3)
        assert policy["by_episode"]["success"] == (distances[:, -1] < 5).tolist()
        assert f"{policy['final_distance_cm']['value']:.1f} [" in rows[name]
    assert reported["policies"]["tiny"]["why_counts"] == {"planned": 4}
    starts = [policy["by_episode"]["distance_cm"][0][0] for policy in reported["policies"].values()]
    assert starts == starts[:1] * 4  # the same problems for all
    assert (
        read_header(tmp_path / VIDEO_FILE, where="film").num_frames == 4 + 1 + 4
    )  # the first and the last image are held


def test_non_finite_model_returns_zero_actions_and_exits_with_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tiny_model()
    with torch.no_grad():
        broken.base_predictor.predictor_proj.weight.fill_(1e38)  # finite, and nothing that comes of it is
    broken.save_pretrained(tmp_path / "broken")
    out = tmp_path / "out"
    assert main(["simulate", str(tmp_path / "broken"), *TWICE, "--films", "0", "--out", str(out), *SMALL]) == 1
    assert "broken: 4 of 4 decisions: no finite energy" in capsys.readouterr().out
    broken_model, zero_action = (metrics(out)["policies"][name]["by_episode"] for name in ("broken", "zero action"))
    assert broken_model["distance_cm"] == zero_action["distance_cm"]


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        (["{model}", "--domain", "random"], "Expected A or B"),
        (["{model}", "--workers", "2"], "--workers"),
        (["{model}", "--out", "{model}/config.json"], "config.json"),
        (["{model}", "training.steps=3"], "training.steps=3"),
        (["{model}", "data.stride=auto"], "data.stride"),
        (["{model}", "data.pose_frame=camera"], "data.pose_frame"),
        (["record"], "one folder"),
        (["record", "{here}/x", "--films", "1"], "--films"),
    ],
)
def test_invalid_simulate_options_print_one_error_line(
    words: list[str], wrong: str, model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [word.format(model=model, here=tmp_path) for word in words]
    assert main(["simulate", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert wrong in error
    assert not list(tmp_path.iterdir())


def test_sub_goals_come_from_a_demonstration_of_the_same_problem(model: str, tmp_path: Path) -> None:
    arguments = ["simulate", model, "--task", "reach", "--episodes", "1", "--steps", "4", "--films", "0", *SMALL]
    runs = {}
    goal_options = {name: ["--sub-goals", name] for name in ("demonstration", "every-step")}
    for name, options in {"single": [], **goal_options}.items():
        assert main([*arguments, *options, "--out", str(tmp_path / name)]) == 0
        runs[name] = metrics(tmp_path / name)
    assert [run["about"]["sub_goals"] for run in runs.values()] == ["none", *goal_options]
    distances = [run["policies"]["tiny"]["by_episode"]["distance_cm"] for run in runs.values()]
    assert distances[0] != distances[1] != distances[2] != distances[0]
    for name in ("zero action", "oracle"):
        single, *with_sub_goals = (run["policies"][name]["by_episode"]["distance_cm"] for run in runs.values())
        assert with_sub_goals == [single, single], "only the model uses sub-goals"
