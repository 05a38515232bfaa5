"""Problem manifests: a measurement can be repeated from its manifest alone."""

import json
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

import fake_world
from vjepa2_ac.cli import main
from vjepa2_ac.simulation.manifest import remove_paths
from vjepa2_ac.storage.paths import CLOSED_LOOP_FILE

SETTINGS = ["planning.samples=6", "planning.iterations=2", "planning.planner.options.elites=3"]
PROBLEMS = ["--task", "push", "--domain", "B", "--episodes", "2", "--steps", "2", "--seed", "5"]


def simulate(model: str, manifest: Path, out: Path, *options: str) -> int:
    return main(["simulate", model, "--manifest", str(manifest), "--films", "0", "--out", str(out), *options])


def results_without_times(folder: Path) -> dict[str, Any]:
    policies = json.loads((folder / CLOSED_LOOP_FILE).read_text())["policies"]
    for policy in policies.values():
        del policy["seconds_per_decision"], policy["by_episode"]["seconds"]
    return policies


@pytest.fixture(scope="module")
def measured(model: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a manifest and the result of the measurement that wrote it."""
    folder = tmp_path_factory.mktemp("manifest")
    assert simulate(model, folder / "manifest.json", folder, *PROBLEMS, *SETTINGS) == 0
    return folder


def test_repetition_from_a_manifest_has_the_same_results(model: str, measured: Path, tmp_path: Path) -> None:
    before = (measured / "manifest.json").read_bytes()
    assert simulate(model, measured / "manifest.json", tmp_path) == 0
    assert results_without_times(tmp_path) == results_without_times(measured)
    assert (measured / "manifest.json").read_bytes() == before


def test_problems_come_from_the_manifest_not_from_its_seed(model: str, measured: Path, tmp_path: Path) -> None:
    values = json.loads((measured / "manifest.json").read_text())
    del values["problems"][0]
    values["seed"] = 77
    (tmp_path / "manifest.json").write_text(json.dumps(values))
    assert simulate(model, tmp_path / "manifest.json", tmp_path) == 0
    expected = results_without_times(measured)["zero action"]["by_episode"]["distance_cm"][1:]
    assert results_without_times(tmp_path)["zero action"]["by_episode"]["distance_cm"] == expected


@pytest.mark.parametrize(
    "word", ["--seed=1", "--task=reach", "planning.samples=8", "planning.views=1", "planning.budget_s=9"]
)
def test_setting_that_the_manifest_determines_is_refused(
    word: str, model: str, measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate(model, measured / "manifest.json", tmp_path, word) == 2
    assert f"{word.partition('=')[0] if word[0] == '-' else word} with --manifest" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("format", 2, "format"),
        ("problems", [], "problems"),
        ("planning", {"prior": "/etc/passwd"}, "planning.prior"),
        ("planning", {"samples": "many"}, "planning.samples"),
        ("stride", 5, "data.stride: 4"),
    ],
)
def test_damaged_manifest_is_refused_before_planning(
    key: str, value: Any, message: str, model: str, measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = json.loads((measured / "manifest.json").read_text()) | {key: value}
    (tmp_path / "manifest.json").write_text(json.dumps(values))
    assert simulate(model, tmp_path / "manifest.json", tmp_path) == 2
    assert message in capsys.readouterr().err


# ---- third-party environments ----


def world(fault: str) -> list[str]:
    return ["--world", shlex.join([sys.executable, fake_world.__file__, fault])]


@pytest.fixture(scope="module")
def measured_world(model: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the manifest and the result of a measurement in an environment with some hard problems."""
    folder = tmp_path_factory.mktemp("world")
    arguments = [*world("sometimes hard"), "--episodes", "2", "--steps", "3", "--sub-goals", "demonstration"]
    assert simulate(model, folder / "manifest.json", folder, *arguments, *SETTINGS) == 0
    return folder


def test_repetition_in_a_third_party_environment_has_the_same_results(
    model: str, measured_world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (measured_world / "manifest.json").read_text()
    assert simulate(model, measured_world / "manifest.json", tmp_path, *world("sometimes hard")) == 0
    assert results_without_times(tmp_path) == results_without_times(measured_world)
    assert "Difference from the manifest" not in capsys.readouterr().out
    assert (measured_world / "manifest.json").read_text() == text
    values = json.loads(text)
    assert values["command"] == ["fake_world.py", "sometimes hard"]
    assert values["world_versions"] == {"mujoco": "3.0"}
    assert [problem["seed"] for problem in values["problems"]] == [0, 2]


def test_differences_between_environment_and_manifest_are_reported(
    model: str, measured_world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = json.loads((measured_world / "manifest.json").read_text())
    values["world_versions"] = {"mujoco": "2.9", "numpy": "1.0"}
    values["problems"].append(values["problems"][0] | {"seed": 1})
    values["problems"][0]["start"][0] += 0.05
    (tmp_path / "manifest.json").write_text(json.dumps(values))
    assert simulate(model, tmp_path / "manifest.json", tmp_path, *world("sometimes hard")) == 0
    differences = [
        "mujoco: 3.0, in the manifest 2.9",
        "numpy: version not reported, in the manifest 1.0",
        "problem 0: another start than in the manifest (the hand 5.0 cm, the object's distance 0.0 cm)",
        "problem 1: left out, because the expert does not solve it",
    ]
    shown = " ".join(capsys.readouterr().out.split())
    assert all(line in shown for line in differences[:2])
    about = json.loads((tmp_path / CLOSED_LOOP_FILE).read_text())["about"]
    assert about["warnings"][-4:] == [f"Difference from the manifest: {line}" for line in differences]
    assert (about["seeds"], about["left_out"], about["episodes"]) == ([0, 2], [1], 2)


@pytest.mark.parametrize(
    ("manifest", "options", "message"),
    [
        ("measured_world", world("hard"), "command fake_world.py hard. Expected fake_world.py 'sometimes hard'"),
        ("measured_world", [*world("sometimes hard"), "--seed", "1"], "--seed with --manifest"),
        ("measured_world", [], "problems in a third-party environment"),
        ("measured", world(""), "problems in the simulated arm"),
    ],
)
def test_manifest_of_another_environment_is_refused(
    manifest: str,
    options: list[str],
    message: str,
    model: str,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = request.getfixturevalue(manifest) / "manifest.json"
    assert simulate(model, path, tmp_path, *options) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("/home/a/bin/python3 /home/a/libero.py suite --task 3", ["libero.py", "suite", "--task", "3"]),
        ("./lift --assets=/home/a/files --near", ["lift", "--assets=files", "--near"]),
    ],
)
def test_command_of_a_manifest_has_no_paths(command: str, words: list[str]) -> None:
    assert list(remove_paths(command)) == words
