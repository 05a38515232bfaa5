"""A recommended command parses, and sets the same options as the user's, but for those that have to change."""

import argparse
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

import vjepa2_ac
from vjepa2_ac.cli.closed_loop import _summary
from vjepa2_ac.cli.evaluate import _next
from vjepa2_ac.cli.options import QUICK_WORDS, option_words, parsed, quick_words
from vjepa2_ac.cli.program import _parser
from vjepa2_ac.config.loading import config_as_yaml, load_config
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.errors import shell_command
from vjepa2_ac.evaluation.summary import Summary, not_measured_verdict
from vjepa2_ac.reports.metrics_json import METRICS_FILE
from vjepa2_ac.simulation import record
from vjepa2_ac.simulation.record import RecordedSimulation, RecordingSpec


def parse(words: list[str]) -> argparse.Namespace:
    return parsed(_parser(), words)


def without_words(options: argparse.Namespace) -> dict[str, object]:
    return {name: value for name, value in vars(options).items() if name not in {"parser", "handler"}}


def test_the_words_of_options_give_the_same_options() -> None:
    words = ["serve", "my run", "--goals", "a b", "--checkpoint", "3", "--plugin", "one", "--plugin", "two"]
    options = parse(words)
    names = ("goals", "checkpoint", "plugin", "config")
    line = shlex.split(shell_command("serve", "my run", *option_words(options, *names)))
    assert without_words(parse(line[1:])) == without_words(options)
    assert option_words(options, "checkpoint") == ["--checkpoint", "3"]


@pytest.mark.parametrize(
    ("words", "settings", "on_cpu", "is_quick"),
    [
        ([], {}, True, True),
        ([], {}, False, False),
        ([], {"samples": 64, "iterations": 4}, True, False),
        (["planning.samples=800"], {}, True, False),
        (["planning.horizon=2"], {"horizon": 2}, True, True),
        ([], {"budget_s": 1.0}, True, False),
        ([], {"planner": {"name": "cem", "options": {"elites": 100}}}, True, False),
    ],
)
def test_a_cpu_gets_the_quick_planner_unless_the_user_chose(words, settings, *, on_cpu: bool, is_quick: bool) -> None:
    assert quick_words(words, PlanningConfig(**settings), on_cpu=on_cpu) == [*QUICK_WORDS] * is_quick


def next_of_evaluate(
    words: str,
    *,
    checkpoint: str = "step-00000008 (the newest)",
    needs: str = "",
    predicts: str = "yes",
    ranks: str = "yes",
    plans: str | None = None,
    is_base: bool = False,
) -> list[str]:
    """Return the lines that `evaluate` prints for an evaluation of these words."""
    options = parse(["evaluate", *shlex.split(words)])
    about = SimpleNamespace(subject=options.subject, checkpoint=checkpoint, data=__file__, is_base=is_base)
    first = SimpleNamespace(needs=needs, conclusion=predicts)
    planning = None if plans is None else SimpleNamespace(conclusion=plans)
    verdicts = (first, SimpleNamespace(conclusion="yes"), planning or SimpleNamespace(conclusion=ranks))
    summary = SimpleNamespace(prediction=first, planning=planning, verdicts=verdicts)
    return _next(SimpleNamespace(evaluation=SimpleNamespace(about=about), summary=summary), options)


@pytest.mark.parametrize(("step", "is_same"), [(10, True), (20, False)])
def test_closed_loop_summary_includes_an_evaluation_of_the_same_checkpoint_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int, *, is_same: bool
) -> None:
    verdict = not_measured_verdict("planning", "`vjepa2-ac simulate`")
    summary = Summary("run", "on 9 clips", verdict, verdict, verdict, None)
    about = SimpleNamespace(checkpoint=f"step-{step:08d} (as asked for)")  # older versions wrote these words
    monkeypatch.setattr(
        "vjepa2_ac.reports.metrics_json.read_metrics", lambda _: SimpleNamespace(about=about, summary=summary)
    )
    (tmp_path / METRICS_FILE).touch()
    subject = SimpleNamespace(name=str(tmp_path), checkpoint_label="step-00000010 (as requested)")
    trials = SimpleNamespace(task="reach", place="domain A", steps=20, seconds_per_step=0.25)
    options = parse(["simulate", str(tmp_path), "--task", "reach", "--domain", "A"])
    found = _summary(SimpleNamespace(subject=subject, trials=trials), verdict, options)
    assert (found.prediction.name == "planning") == is_same


def test_real_data_are_never_sent_to_the_simulated_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    given = "builtin:sim-tiny --checkpoint 8"
    (command,) = next_of_evaluate(given)
    assert command == "Next: vjepa2-ac serve builtin:sim-tiny --checkpoint 8"
    recorded = RecordedSimulation.of(RecordingSpec("B", task="pick"), 3)
    monkeypatch.setattr(record, "read_simulation", lambda _: recorded)
    (command,) = next_of_evaluate(given)
    quick = "planning.samples=64 planning.iterations=4"
    expected = f"simulate builtin:sim-tiny --task pick --domain B --checkpoint 8 {quick}"
    assert command == f"Next: vjepa2-ac {expected}"
    parse(shlex.split(expected))


def test_name_of_a_model_is_no_setting_and_no_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record, "read_simulation", lambda _: RecordedSimulation.of(RecordingSpec("B", task="pick"), 3))
    model = shutil.copytree(Path(vjepa2_ac.__file__).parent / "assets/sim-tiny", tmp_path / "reach=1")
    monkeypatch.chdir(tmp_path)
    (command,) = next_of_evaluate(model.name)
    assert command.startswith("Next: vjepa2-ac simulate reach=1 --task pick ")


def test_a_robot_is_recommended_only_after_a_measured_gain() -> None:
    check = ["Next: vjepa2-ac data check runs/a/config.yaml --model runs/a"]
    serve = ["Next: vjepa2-ac serve runs/a"]
    assert next_of_evaluate("runs/a", ranks="no") == next_of_evaluate("runs/a", plans="no") == check
    assert next_of_evaluate("runs/a", ranks="inconclusive") == next_of_evaluate("runs/a", plans="inconclusive") == []
    assert next_of_evaluate("runs/a", plans="yes") == serve


def test_what_comes_before_planning_keeps_the_data(tmp_path: Path) -> None:
    other = tmp_path / "my robot.yaml"
    other.write_text(config_as_yaml(load_config("builtin:demo", [f"data.path={tmp_path}"])))
    given, check = f"runs/a --data '{other}' --out out model.base=moved", f"Next: vjepa2-ac data check '{other}'"
    assert next_of_evaluate(given, needs="1 episode is too few.") == [check]
    assert next_of_evaluate(given, predicts="no") == [check], "a moved base cannot be named there"
    assert next_of_evaluate(f"runs/a --data '{other}' --out out", predicts="no") == [f"{check} --model runs/a"]
    assert next_of_evaluate("runs/a", predicts="no") == ["Next: vjepa2-ac data check runs/a/config.yaml --model runs/a"]
    assert next_of_evaluate("runs/a", is_base=True) == next_of_evaluate("runs/a", predicts="no")
    expected = f"train '{other}' model.base=my.pt"
    assert next_of_evaluate(f"my.pt --data '{other}' --out out", checkpoint="") == [f"Next: vjepa2-ac {expected}"]
    assert parse(shlex.split(expected)).overrides == ["model.base=my.pt"]
