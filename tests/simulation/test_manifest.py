"""Problem manifests: a measurement can be repeated from its manifest alone."""

import json
from pathlib import Path
from typing import Any

import pytest

from vjepa2_ac.cli import main
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


@pytest.mark.parametrize("word", ["--seed=1", "--task=reach", "planning.samples=8", "planning.limits.rotation=0.1"])
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


def test_manifest_of_a_third_party_environment_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate("model", tmp_path / "manifest.json", tmp_path, "--world", "true") == 2
    assert "whose problems are determined by --seed" in capsys.readouterr().err
