"""A recommended command parses, and sets the same options as the user's, but for those that have to change."""

import argparse
import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from vjepa2_ac.cli.console.progress import ConsoleReporter
from vjepa2_ac.cli.evaluate import _next
from vjepa2_ac.cli.next_command import QUICK, next_simulation, option_words
from vjepa2_ac.cli.options import parsed
from vjepa2_ac.cli.program import _parser
from vjepa2_ac.config.loading import config_as_yaml, load_config
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.errors import shell_command
from vjepa2_ac.planning.planner import samples_of_iterations
from vjepa2_ac.simulation import record
from vjepa2_ac.simulation.record import RecordedSimulation, RecordingSpec


def parse(words: list[str]) -> argparse.Namespace:
    return parsed(_parser(words), words)


def without_words(options: argparse.Namespace) -> dict[str, object]:
    return {name: value for name, value in vars(options).items() if name not in {"parser", "handler"}}


def any_value(action: argparse.Action, generator: np.random.Generator) -> str:
    """Return a value that the option accepts."""
    candidates = list(action.choices or ["3", "2", "0.5", "64", "a b.png", "it's", "-0.3,0.1", "x/y"])
    for place in generator.permutation(len(candidates)):
        try:
            action.type(candidates[place]) if action.type else None
        except (argparse.ArgumentTypeError, ValueError):
            continue
        return candidates[place]
    raise AssertionError(action)


@pytest.mark.parametrize("command", ["simulate", "evaluate", "plan", "serve", "train", "goals", "explore"])
def test_the_words_of_options_give_the_same_options(command: str) -> None:
    """Random options of each command, whatever their kind: flags, lists, repeatable ones, paths with spaces."""
    generator = np.random.default_rng(0)
    known = next(a for a in _parser()._actions if isinstance(a, argparse._SubParsersAction)).choices[command]
    optional = [one for one in known._actions if one.option_strings and one.dest not in {"help", "goal_from", "goals"}]
    for _ in range(8):
        words = [command, *(["run"] if command != "goals" else ["film.mp4"]), "planning.samples=32"]
        for action in optional:
            if action.required or generator.random() < 0.3:
                count = {None: 1, "?": 1, 0: 0}.get(action.nargs, 2)
                values = [any_value(action, generator) for _ in range(count)]
                words += [action.option_strings[0], *values]
        words += ["--goal", "a b.png"] * (command == "plan")
        options = parse(words)
        line = shlex.split(shell_command(command, *words[1:2], *option_words(options)))[1:]
        again = parse([line[0], line[1], "planning.samples=32", *line[2:]])
        assert without_words(again) == without_words(options), words


def test_only_the_changed_options_change() -> None:
    words = [
        "simulate",
        "my run",
        "--domain",
        "B",
        "--task",
        "pick",
        "--episodes",
        "3",
        "--goals",
        "a b",
        "planning.samples=9",
    ]
    options = parse(words)
    line = shlex.split(shell_command("simulate", "my run", *option_words(options, episodes=50), *options.overrides))
    assert without_words(parse(line[1:])) == without_words(options) | {"episodes": 50}
    assert option_words(options, "domain", "checkpoint") == ["--domain", "B"]


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
    planning = PlanningConfig(**settings)
    command, time = next_simulation(["run", *words], planning, 400, 1e-3, on_cpu=on_cpu)
    assert all((f"planning.{key}={value}" in command) == is_quick for key, value in QUICK.items())
    sequences = 256 if is_quick else sum(samples_of_iterations(planning))
    minutes = round(400 * sequences * planning.horizon * 1e-3 / 60)
    expected = f"about {minutes} minutes" if minutes < 60 else f"about {minutes / 60:.1f} hours"
    where = "on this CPU with the quick planner" if is_quick else "here"
    assert time == f"  ({expected} {where}: 400 decisions of {sequences:,} action sequences each)"
    assert len(time) <= 100


def test_a_time_that_was_not_measured_is_not_claimed() -> None:
    assert (
        "its time was not measured: 400 decisions"
        in next_simulation(["run"], PlanningConfig(), 400, None, on_cpu=True)[1]
    )


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
    options, reporter = parse(["evaluate", *shlex.split(words)]), ConsoleReporter()
    reporter.seconds["action ranking, adapter"] = 2.0
    ranking = SimpleNamespace(ranks=np.zeros(10), samples=50)
    about = SimpleNamespace(subject=options.subjects[0], checkpoint=checkpoint, data=__file__, is_base=is_base)
    first = SimpleNamespace(needs=needs, conclusion=predicts)
    planning = None if plans is None else SimpleNamespace(conclusion=plans)
    verdicts = (first, SimpleNamespace(conclusion="yes"), planning or SimpleNamespace(conclusion=ranks))
    summary = SimpleNamespace(predicts=first, plans=planning, verdicts=verdicts)
    adapter = SimpleNamespace(ranking=ranking)
    evaluation = SimpleNamespace(about=about, trained="adapter", models={"adapter": adapter})
    return _next(SimpleNamespace(evaluation=evaluation, summary=summary), options, reporter)


def test_real_data_are_never_sent_to_the_simulated_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    given = "builtin:sim-tiny --checkpoint 8"
    (command,) = next_of_evaluate(given)
    assert command == "Next: vjepa2-ac serve builtin:sim-tiny --checkpoint 8"
    recorded = RecordedSimulation.of(RecordingSpec("B", task="pick"), 3)
    monkeypatch.setattr(record, "read_simulation", lambda _: recorded)
    command, time = next_of_evaluate(given)
    quick = "planning.samples=64 planning.iterations=4"
    expected = f"simulate builtin:sim-tiny --task pick --domain B --checkpoint 8 {quick}"
    assert command == f"Next: vjepa2-ac {expected}"
    parse(shlex.split(expected))
    minutes = round(50 * 12 * 256 * 2.0 / (10 * 101) / 60)  # decisions, sequences, steps, measured seconds
    where = "on this CPU with the quick planner"
    assert time == f"  (about {minutes} minutes {where}: 600 decisions of 256 action sequences each)"


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
