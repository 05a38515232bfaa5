"""A recommended command parses, and sets the same options as the user's command, except those that must differ."""

import argparse
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

import vjepa2_ac
from vjepa2_ac.cli.closed_loop import _make_summary
from vjepa2_ac.cli.evaluate import _recommend_next
from vjepa2_ac.cli.options import make_option_words, parse_arguments
from vjepa2_ac.cli.program import _make_parser
from vjepa2_ac.config.loading import config_as_yaml, load_config
from vjepa2_ac.errors import shell_command
from vjepa2_ac.evaluation.summary import Summary, not_measured_verdict
from vjepa2_ac.reports.metrics_json import METRICS_FILE
from vjepa2_ac.simulation import record
from vjepa2_ac.simulation.record import RecordedSimulation, RecordingSpec


def parse(words: list[str]) -> argparse.Namespace:
    return parse_arguments(_make_parser(), words)


def without_parser(options: argparse.Namespace) -> dict[str, object]:
    return {name: value for name, value in vars(options).items() if name not in {"parser", "handler"}}


def test_option_words_parse_to_the_same_options() -> None:
    words = ["serve", "my run", "--goals", "a b", "--checkpoint", "3", "--plugin", "one", "--plugin", "two"]
    options = parse(words)
    names = ("goals", "checkpoint", "plugin", "config")
    line = shlex.split(shell_command("serve", "my run", *make_option_words(options, *names)))
    assert without_parser(parse(line[1:])) == without_parser(options)
    assert make_option_words(options, "checkpoint") == ["--checkpoint", "3"]


def get_next_command(
    words: str,
    *,
    checkpoint: str = "step-00000008 (the newest)",
    needs: str = "",
    predicts: str = "yes",
    ranks: str = "yes",
    plans: str | None = None,
    is_base: bool = False,
) -> list[str]:
    """Return the recommended next command after `evaluate` with these arguments and verdicts."""
    options = parse(["evaluate", *shlex.split(words)])
    about = SimpleNamespace(subject=options.subject, checkpoint=checkpoint, data=__file__, is_base=is_base)
    first = SimpleNamespace(needs=needs, conclusion=predicts)
    planning = None if plans is None else SimpleNamespace(conclusion=plans)
    verdicts = (first, SimpleNamespace(conclusion="yes"), planning or SimpleNamespace(conclusion=ranks))
    summary = SimpleNamespace(prediction=first, planning=planning, verdicts=verdicts)
    return _recommend_next(SimpleNamespace(evaluation=SimpleNamespace(about=about), summary=summary), options)


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
    closed_loop_summary = _make_summary(SimpleNamespace(subject=subject, trials=trials), verdict, options)
    assert (closed_loop_summary.prediction.name == "planning") == is_same


def test_simulate_is_recommended_only_for_simulated_data(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = "builtin:sim-tiny --checkpoint 8"
    (command,) = get_next_command(arguments)
    assert command == "Next: vjepa2-ac serve builtin:sim-tiny --checkpoint 8"
    recorded = RecordedSimulation.of(RecordingSpec("B", task="pick"), 3)
    monkeypatch.setattr(record, "read_simulation", lambda _: recorded)
    (command,) = get_next_command(arguments)
    expected = "simulate builtin:sim-tiny --task pick --domain B --checkpoint 8"
    assert command == f"Next: vjepa2-ac {expected}"
    parse(shlex.split(expected))


def test_model_folder_with_an_equals_sign_is_not_read_as_an_override(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record, "read_simulation", lambda _: RecordedSimulation.of(RecordingSpec("B", task="pick"), 3))
    model = shutil.copytree(Path(vjepa2_ac.__file__).parent / "assets/sim-tiny", tmp_path / "reach=1")
    monkeypatch.chdir(tmp_path)
    (command,) = get_next_command(model.name)
    assert command.startswith("Next: vjepa2-ac simulate reach=1 --task pick ")


def test_serve_is_recommended_only_after_a_measured_improvement() -> None:
    check = ["Next: vjepa2-ac data check runs/a/config.yaml --model runs/a"]
    serve = ["Next: vjepa2-ac serve runs/a"]
    assert get_next_command("runs/a", ranks="no") == get_next_command("runs/a", plans="no") == check
    assert get_next_command("runs/a", ranks="inconclusive") == get_next_command("runs/a", plans="inconclusive") == []
    assert get_next_command("runs/a", plans="yes") == serve


def test_recommended_check_and_train_commands_keep_the_data_config(tmp_path: Path) -> None:
    other = tmp_path / "my robot.yaml"
    other.write_text(config_as_yaml(load_config("builtin:demo", [f"data.path={tmp_path}"])))
    arguments, check = f"runs/a --data '{other}' --out out model.base=moved", f"Next: vjepa2-ac data check '{other}'"
    assert get_next_command(arguments, needs="1 episode is too few.") == [check]
    assert get_next_command(arguments, predicts="no") == [check], "`data check --model` has no option for a moved base"
    assert get_next_command(f"runs/a --data '{other}' --out out", predicts="no") == [f"{check} --model runs/a"]
    assert get_next_command("runs/a", predicts="no") == ["Next: vjepa2-ac data check runs/a/config.yaml --model runs/a"]
    assert get_next_command("runs/a", is_base=True) == get_next_command("runs/a", predicts="no")
    expected = f"train '{other}' model.base=my.pt"
    assert get_next_command(f"my.pt --data '{other}' --out out", checkpoint="") == [f"Next: vjepa2-ac {expected}"]
    assert parse(shlex.split(expected)).overrides == ["model.base=my.pt"]
