"""`vjepa2-ac plan` writes a plan and its image, or reports invalid input before planning."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from random_decoder import write_decoder
from tiny_models import tiny_model
from vjepa2_ac.cli import main
from vjepa2_ac.planning.decision import decide

STATE = "0.4,0.0,0.3,3.1,0.0,0.1,0.2"
QUICK = ["planning.samples=8", "planning.iterations=2", "planning.planner.options.elites=4", "--nodes", "0"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with images, a model, a broken model, and a model that needs a camera pose."""
    folder = tmp_path_factory.mktemp("folder")
    for name, seed, size in (
        ("start", 0, (60, 48)),
        ("goal", 1, (60, 48)),
        ("other", 2, (48, 60)),
        ("tiny", 3, (8, 8)),
    ):
        pixels = np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{name}.png")
    (folder / "notes.png").write_text("x,y,z")
    black = np.zeros((60, 48), np.uint8)
    Image.fromarray(black).save(folder / "black.png")
    black[:20, :20] = 255
    Image.fromarray(black).save(folder / "mask.png")
    tiny_model().save_pretrained(folder / "model")
    tiny_model(extrinsics=True).save_pretrained(folder / "camera")
    broken = tiny_model()
    with torch.no_grad():
        broken.base_predictor.predictor_proj.weight.fill_(1e38)  # finite, but the predictions are not
    broken.save_pretrained(folder / "broken")
    return folder


@pytest.fixture
def no_plot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw no image, which takes most of the time."""
    monkeypatch.setattr("vjepa2_ac.reports.planning_figures.plot_plan", lambda _, path, *__: path)


def plan(
    folder: Path, *options: str, subject: str = "model", state: str = STATE, goal: str = "goal"
) -> tuple[int, dict]:
    images = ["--start", str(folder / "start.png"), "--goal", str(folder / f"{goal}.png")]
    out = folder / "out"
    status = main(["plan", str(folder / subject), *images, "--state", state, "--out", str(out), *options])
    return status, json.loads((out / "plan.json").read_text()) if status < 2 else {}


def test_plan_writes_json_and_an_image_and_prints_a_table(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, file = plan(folder, *QUICK, "--seed", "9", "--nodes", "3")
    assert status == bool(file["worse_than"])
    reported = capsys.readouterr().out
    assert "Planning: 16 action sequences of 1 step in 2 iterations.\n" in reported
    assert "planning 16/16" in reported
    assert "energy maps 27/27" in reported
    assert "Plan of 1 model step\n" in reported
    assert "Moves" in reported
    assert str(folder / "out" / "plan.png") in reported
    assert (folder / "out" / "plan.png").is_file()
    assert (file["seed"], file["goals"], len(file["slices"])) == (9, [str(folder / "goal.png")], 3)
    assert len(file["model"]["predictor"]) == 64
    assert plan(folder, *QUICK, "--seed", "9")[1]["actions"] == file["actions"]


@pytest.mark.usefixtures("no_plot")
@pytest.mark.parametrize("zero_action_energy", [-1.0, 1e9])
def test_plan_worse_than_the_zero_action_is_reported_first_and_returns_1(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, zero_action_energy: float
) -> None:
    def decide_with_energies(*arguments: Any, **options: Any) -> Any:
        result = decide(*arguments, **options)
        decision = replace(result.decision, current_energy=1e9)
        return replace(result, zero_action_energy=zero_action_energy, decision=decision)

    monkeypatch.setattr("vjepa2_ac.planning.decision.decide", decide_with_energies)
    status, file = plan(folder, *QUICK)
    lines = capsys.readouterr().out.splitlines()
    (first,) = (line for line, after in zip(lines[1:], lines, strict=False) if after.startswith("planning 16/16"))
    is_worse = zero_action_energy < 0
    assert (status, file["worse_than"]) == (int(is_worse), ["zero action"] * is_worse)
    assert first.startswith(
        "The plan is predicted to be worse than the zero action: energy" if is_worse else "Plan of 1"
    )
    assert max(map(len, lines)) <= 100


@pytest.mark.usefixtures("no_plot")
def test_two_goals_divide_the_horizon(folder: Path) -> None:
    second = ["--goal", str(folder / "goal.png")]
    summed = ["planning.energy.steps=sum", "planning.horizon=4"]
    assert plan(folder, *QUICK, *second, *summed)[1]["goal_of_each_step"] == [0, 0, 1, 1]


@pytest.mark.usefixtures("no_plot")
def test_mask_changes_the_energy(folder: Path) -> None:
    unmasked, masked = (plan(folder, *QUICK, *options)[1] for options in ([], ["--mask", str(folder / "mask.png")]))
    assert unmasked["energy"]["now"] != masked["energy"]["now"]


@pytest.mark.usefixtures("no_plot")
def test_camera_pose_changes_the_energy_of_a_model_that_uses_it(folder: Path) -> None:
    energies = [
        plan(folder, *QUICK, "--extrinsics", pose, subject="camera")[1]["energy"]["doing_nothing"]
        for pose in ("-0.4,0.5,0.9,-2,0,1", "1,0.5,0.9,-2,0,1")
    ]
    assert energies[0] != energies[1]


@pytest.mark.usefixtures("no_plot")
def test_state_may_begin_with_a_minus_sign(folder: Path) -> None:
    assert plan(folder, *QUICK, state="-0.4,0,0.3,3.1,0,0.1,0.2")[1]["state"][0] == -0.4
    assert plan(folder, *QUICK, state="-.4 0 0.3 3.1 0 0.1 0.2")[1]["state"][0] == -0.4


@pytest.mark.usefixtures("no_plot")
def test_model_with_infinite_predictions_plans_the_zero_action_and_returns_1(folder: Path) -> None:
    status, file = plan(folder, *QUICK, subject="broken")
    assert (status, file["why"]) == (1, "no finite energy")
    assert not np.any(file["actions"])


WRONG = {
    "goal of another size": (["--goal", "{folder}/other.png"], "48 x 60 pixels (width x height)"),
    "a missing image": (["--goal", "{folder}/nowhere.png"], "nowhere.png: cannot be read: No such file"),
    "a black mask": (["--mask", "{folder}/black.png"], "no pixel inside the cropped image"),
    "degrees": (["--state", "0.4,0,0.3,180,0,5,0"], "multiply them by pi / 180"),
    "too few numbers": (["--state", "0.4,0,0.3"], "3 numbers with shape (3,)"),
    "limits below zero": (["planning.limits.xyz=[-0.05,0.05,0.05]"], "planning.limits.xyz.0"),
    "a config key of training": (["training.steps=2"], "a setting that planning does not use"),
    "a camera that is not used": (["--extrinsics", "0,0,0,0,0,0"], "a camera pose if and only if the model uses it"),
    "a checkpoint of a model": (["--checkpoint", "best"], "not the folder of a run"),
    "a file as output folder": (["--out", "{folder}/notes.png"], "notes.png"),
}  # fmt: skip


@pytest.mark.parametrize(("options", "message"), WRONG.values(), ids=WRONG.keys())
def test_invalid_input_prints_one_error_and_writes_no_plan(
    folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    out = folder / "nothing"
    common = ["--start", str(folder / "start.png"), "--state", STATE, "--out", str(out)]
    goal = [] if "--goal" in options else ["--goal", str(folder / "goal.png")]
    words = [word.format(folder=folder) if "{folder}" in word else word for word in options]
    assert main(["plan", str(folder / "model"), *common, *goal, *QUICK, *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert not (out / "plan.json").exists()


def test_decoder_adds_predicted_frames_to_the_image_and_does_not_change_the_plan(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder = write_decoder(tmp_path / "decoder", tiny_model())
    figures = []
    monkeypatch.setattr(
        "vjepa2_ac.reports.planning_figures.plot_plan", lambda _, path, imagined: figures.append(imagined) or path
    )
    _, plain = plan(folder, *QUICK)
    status, file = plan(folder, *QUICK, "--decoder", str(decoder))
    assert status < 2
    assert figures[0] is None
    assert list(figures[1].steps) == [1]
    assert file["decoder"] == {"name": str(decoder), "encoder": tiny_model().encoder_fingerprint()}
    assert file["actions"] == plain["actions"]
    assert plain["decoder"] is None


@pytest.mark.parametrize("kind", ["missing", "another encoder's"])
def test_unusable_decoder_raises_before_planning(
    folder: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    later_step = (
        "vjepa2_ac.planning.model_setup.load_for_planning"
        if kind == "missing"
        else "vjepa2_ac.planning.decision.decide"
    )
    monkeypatch.setattr(later_step, lambda *_, **__: pytest.fail("too late"))
    if kind != "missing":
        write_decoder(tmp_path / "decoder", tiny_model(), encoder="other")
    assert plan(folder, *QUICK, "--decoder", str(tmp_path / "decoder"))[0] == 2
    error = capsys.readouterr().err
    assert f"--decoder {tmp_path}/decoder" in error.replace("\n", "")
    assert "Train a decoder" in error
