"""`vjepa2-ac plan` writes a plan and its figure, or reports an error before anything is loaded."""

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
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with images, a model, a broken one, and one that needs a camera's pose."""
    here = tmp_path_factory.mktemp("workshop")
    for name, seed, size in (
        ("start", 0, (60, 48)),
        ("goal", 1, (60, 48)),
        ("other", 2, (48, 60)),
        ("tiny", 3, (8, 8)),
    ):
        pixels = np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(here / f"{name}.png")
    (here / "notes.png").write_text("x,y,z")
    black = np.zeros((60, 48), np.uint8)
    Image.fromarray(black).save(here / "black.png")
    black[:20, :20] = 255
    Image.fromarray(black).save(here / "mask.png")
    tiny_model().save_pretrained(here / "model")
    tiny_model(extrinsics=True).save_pretrained(here / "camera")
    broken = tiny_model()
    with torch.no_grad():
        broken.base_predictor.predictor_proj.weight.fill_(1e38)  # finite, and nothing that comes of it is
    broken.save_pretrained(here / "broken")
    return here


@pytest.fixture
def no_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the image, which takes most of the time."""
    monkeypatch.setattr("vjepa2_ac.reports.planning_figures.plot_plan", lambda _, path, *__: path)


def plan(here: Path, *more: str, subject: str = "model", state: str = STATE, goal: str = "goal") -> tuple[int, dict]:
    images = ["--start", str(here / "start.png"), "--goal", str(here / f"{goal}.png")]
    out = here / "out"
    status = main(["plan", str(here / subject), *images, "--state", state, "--out", str(out), *more])
    return status, json.loads((out / "plan.json").read_text()) if status < 2 else {}


def test_a_plan_its_image_a_table_and_words_come_out(workshop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, file = plan(workshop, *QUICK, "--seed", "9", "--nodes", "3")
    assert status == bool(file["worse_than"])
    reported = capsys.readouterr().out
    assert "Planning: 16 action sequences of 1 step in 2 iterations.\n" in reported
    assert "planning 16/16" in reported
    assert "energy maps 27/27" in reported
    assert "Plan of 1 model step\n" in reported
    assert "Moves" in reported
    assert str(workshop / "out" / "plan.png") in reported
    assert (workshop / "out" / "plan.png").is_file()
    assert (file["seed"], file["goals"], len(file["slices"])) == (9, [str(workshop / "goal.png")], 3)
    assert len(file["model"]["predictor"]) == 64
    assert plan(workshop, *QUICK, "--seed", "9")[1]["actions"] == file["actions"]


@pytest.mark.usefixtures("no_figure")
@pytest.mark.parametrize("still", [-1.0, 1e9])
def test_a_plan_that_is_predicted_to_be_worse_is_said_first_and_ends_with_status_1(
    workshop: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, still: float
) -> None:
    def decided(*given: Any, **how: Any) -> Any:
        found = decide(*given, **how)
        return replace(found, zero_action_energy=still, decision=replace(found.decision, current_energy=1e9))

    monkeypatch.setattr("vjepa2_ac.planning.decision.decide", decided)
    status, file = plan(workshop, *QUICK)
    lines = capsys.readouterr().out.splitlines()
    (first,) = (line for line, after in zip(lines[1:], lines, strict=False) if after.startswith("planning 16/16"))
    is_worse = still < 0
    assert (status, file["worse_than"]) == (int(is_worse), ["zero action"] * is_worse)
    assert first.startswith(
        "The plan is predicted to be worse than the zero action: energy" if is_worse else "Plan of 1"
    )
    assert max(map(len, lines)) <= 100


@pytest.mark.usefixtures("no_figure")
def test_goals_follow_one_another(workshop: Path) -> None:
    second = ["--goal", str(workshop / "goal.png")]
    summed = ["planning.energy.steps=sum", "planning.horizon=4"]
    assert plan(workshop, *QUICK, *second, *summed)[1]["goal_of_each_step"] == [0, 0, 1, 1]


@pytest.mark.usefixtures("no_figure")
def test_a_mask_changes_what_counts(workshop: Path) -> None:
    whole, part = (plan(workshop, *QUICK, *more)[1] for more in ([], ["--mask", str(workshop / "mask.png")]))
    assert whole["energy"]["now"] != part["energy"]["now"]


@pytest.mark.usefixtures("no_figure")
def test_a_camera_pose_is_taken_where_the_model_needs_one(workshop: Path) -> None:
    found = [
        plan(workshop, *QUICK, "--extrinsics", pose, subject="camera")[1]["energy"]["doing_nothing"]
        for pose in ("-0.4,0.5,0.9,-2,0,1", "1,0.5,0.9,-2,0,1")
    ]
    assert found[0] != found[1]


@pytest.mark.usefixtures("no_figure")
def test_a_state_may_begin_with_a_minus(workshop: Path) -> None:
    assert plan(workshop, *QUICK, state="-0.4,0,0.3,3.1,0,0.1,0.2")[1]["state"][0] == -0.4
    assert plan(workshop, *QUICK, state="-.4 0 0.3 3.1 0 0.1 0.2")[1]["state"][0] == -0.4


@pytest.mark.usefixtures("no_figure")
def test_a_broken_model_leads_to_no_motion_and_to_status_1(workshop: Path) -> None:
    status, file = plan(workshop, *QUICK, subject="broken")
    assert (status, file["why"]) == (1, "no finite energy")
    assert not np.any(file["actions"])


WRONG = {
    "goal of another size": (["--goal", "{here}/other.png"], "48 x 60 pixels (width x height)"),
    "an image that is not there": (["--goal", "{here}/nowhere.png"], "nowhere.png: cannot be read: No such file"),
    "a black mask": (["--mask", "{here}/black.png"], "no pixel inside the cropped image"),
    "degrees": (["--state", "0.4,0,0.3,180,0,5,0"], "multiply them by pi / 180"),
    "too few numbers": (["--state", "0.4,0,0.3"], "3 numbers with shape (3,)"),
    "limits below zero": (["planning.limits.xyz=[-0.05,0.05,0.05]"], "planning.limits.xyz.0"),
    "a knob of training": (["training.steps=2"], "a setting that planning does not use"),
    "a camera that is not used": (["--extrinsics", "0,0,0,0,0,0"], "a camera pose if and only if the model uses it"),
    "a checkpoint of a model": (["--checkpoint", "best"], "not the folder of a run"),
    "a file in the way": (["--out", "{here}/notes.png"], "notes.png"),
}  # fmt: skip


@pytest.mark.parametrize(("more", "complaint"), WRONG.values(), ids=WRONG.keys())
def test_wrong_input_prints_one_error(
    workshop: Path, capsys: pytest.CaptureFixture[str], more: list[str], complaint: str
) -> None:
    out = workshop / "nothing"
    given = ["--start", str(workshop / "start.png"), "--state", STATE, "--out", str(out)]
    goal = [] if "--goal" in more else ["--goal", str(workshop / "goal.png")]
    words = [word.format(here=workshop) if "{here}" in word else word for word in more]
    assert main(["plan", str(workshop / "model"), *given, *goal, *QUICK, *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert complaint in error
    assert not (out / "plan.json").exists()


def test_a_decoder_shows_what_was_imagined_and_only_its_name_goes_into_the_file(
    workshop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_decoder(tmp_path / "decoder", tiny_model())
    drawn = []
    monkeypatch.setattr(
        "vjepa2_ac.reports.planning_figures.plot_plan", lambda _, path, imagined: drawn.append(imagined) or path
    )
    _, plain = plan(workshop, *QUICK)
    status, file = plan(workshop, *QUICK, "--decoder", str(folder))
    assert status < 2
    assert drawn[0] is None
    assert list(drawn[1].steps) == [1]
    assert file["decoder"] == {"name": str(folder), "encoder": tiny_model().encoder_fingerprint()}
    assert file["actions"] == plain["actions"]
    assert plain["decoder"] is None


@pytest.mark.parametrize("kind", ["missing", "another encoder's"])
def test_a_decoder_that_will_not_do_is_told_before_the_plan(
    workshop: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    where = (
        "vjepa2_ac.planning.model_setup.load_for_planning"
        if kind == "missing"
        else "vjepa2_ac.planning.decision.decide"
    )
    monkeypatch.setattr(where, lambda *_, **__: pytest.fail("too late"))
    if kind != "missing":
        write_decoder(tmp_path / "decoder", tiny_model(), encoder="other")
    assert plan(workshop, *QUICK, "--decoder", str(tmp_path / "decoder"))[0] == 2
    said = capsys.readouterr().err
    assert f"--decoder {tmp_path}/decoder" in said.replace("\n", "")
    assert "Train a decoder" in said
