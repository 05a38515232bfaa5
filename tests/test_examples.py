"""Each example runs on a fresh clone, prints its results, and reports wrong input without a traceback."""

import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from paths import ROOT
from simulated import IN_EXAMPLES
from vjepa2_ac.media.images import read_image

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
QUICK = ("training.steps=2", "training.warmup_steps=0", "training.allow_weak_base=true", "validation.every=2")


def main_of(name: str) -> Callable[..., None]:
    main: Callable[..., None] = runpy.run_path(str(ROOT / "examples" / f"{name}.py"))["main"]
    return main


def test_python_page_names_all_example_scripts() -> None:
    page = (ROOT / "docs/python.md").read_text()
    assert {path.stem for path in EXAMPLES} == {"look_at_data", "predict", "finetune", "train_loop", "plan_in_a_loop"}
    assert all(f"python examples/{path.name}" in page for path in EXAMPLES)


def test_look_at_data_records_episodes_once_and_draws_a_sheet(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    simulated: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    calls: list[dict[str, Any]] = []

    def recorded(folder: Path, _spec: object, **options: Any) -> None:
        calls.append(options)
        folder.parent.mkdir(parents=True)
        folder.symlink_to(simulated)

    main = main_of("look_at_data")
    monkeypatch.setitem(main.__globals__, "record_dataset", recorded)
    main()
    main()  # a second look finds them
    assert [options["episodes"] for options in calls] == [12]
    printed = capsys.readouterr().out
    assert printed.count("8 episodes, ") == 2
    assert "(4, 4, 180, 243, 3): clips, time, height, width, RGB" in printed
    assert read_image("demo/examples/contact_sheet.png").shape[2] == 3


@pytest.mark.usefixtures("clone")
def test_predict_example_is_better_than_persistence(capsys: pytest.CaptureFixture[str]) -> None:
    main_of("predict")()
    ratios = [
        float(number) for number in re.findall(r"s ahead.* (\d\.\d+)$", capsys.readouterr().out, flags=re.MULTILINE)
    ]
    assert len(ratios) == 3
    assert max(ratios) < 1


@pytest.mark.usefixtures("clone")
def test_finetune_example_trains_evaluates_and_loads(capsys: pytest.CaptureFixture[str]) -> None:
    main_of("finetune")(str(IN_EXAMPLES), *QUICK)
    printed = capsys.readouterr().out
    for words in ("step 2: loss", "Validation at step 2", "base", "adapter", "report.html", "step-0000000"):
        assert words in printed, words


def test_plan_in_a_loop_example_approaches_the_goal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    main_of("plan_in_a_loop")(samples=40, steps=2)
    distances = [float(number) for number in re.findall(r"([\d.]+) cm from", capsys.readouterr().out)]
    assert len(distances) == 3
    assert distances[-1] < distances[0]
    film = read_image("demo/examples/plan_in_a_loop.png")
    assert film.shape[1] == 4 * 320, "start, two steps, goal"


WRONG = {
    "look_at_data": (["nowhere"], "nowhere"),
    "predict": ([str(IN_EXAMPLES), "builtin:none"], "builtin:sim-tiny"),
    "finetune": (["training.stepz=3"], "did you mean steps"),
    "train_loop": (["nowhere"], "nowhere"),
    "plan_in_a_loop": (["nowhere.pt"], "nowhere.pt"),
}


@pytest.mark.usefixtures("clone")
@pytest.mark.parametrize("name", WRONG)
def test_wrong_input_of_an_example_exits_with_one_error(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments, words = WRONG[name]
    path = str(ROOT / "examples" / f"{name}.py")
    monkeypatch.setattr(sys, "argv", [path, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(path, run_name="__main__")
    assert str(ended.value).startswith("error: ")
    assert words in str(ended.value)
