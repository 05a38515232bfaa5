"""Console output: a progress bar in a terminal and lines otherwise, with literal names and wrapped texts."""

import io
import re
import time

import numpy as np
import pytest
from rich.console import Console
from rich.table import Table

from evaluation_results import ranking_of
from vjepa2_ac.cli import main, tables
from vjepa2_ac.cli import progress as console_module
from vjepa2_ac.cli.progress import ConsoleReporter, ProgressBar
from vjepa2_ac.cli.tables import TrainingConsole
from vjepa2_ac.cli.waiting import Work
from vjepa2_ac.evaluation.measure import VALIDATION_PREDICTIONS
from vjepa2_ac.evaluation.result import PredictionErrors, Validation
from vjepa2_ac.inspection.findings import Finding

METRICS = {
    "loss": 0.51234, "learning_rate": 1e-4, "samples_per_second": 1.5, "memory_gb": 2.5, "data_wait_share": 0.1,
}  # fmt: skip


def replace_console(monkeypatch: pytest.MonkeyPatch, *, terminal: bool) -> io.StringIO:
    """Replace the console by one whose output is returned."""
    output = io.StringIO()
    console = Console(
        file=output, force_terminal=terminal, width=140, highlight=False, soft_wrap=True, color_system=None
    )
    monkeypatch.setattr(console_module, "console", console)
    return output


def errors() -> PredictionErrors:
    ones = np.ones((4, 3))
    better = {("true", "rollout"): 0.5, ("true", "teacher_forced"): 0.25}
    arrays = {
        (actions, mode, "l1"): ones * better.get((actions, mode), 1.0) for actions, mode in VALIDATION_PREDICTIONS
    }
    return PredictionErrors(("a", "b", "c", "d"), arrays)


def test_progress_lines_contain_loss_learning_rate_speed_memory_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    output = replace_console(monkeypatch, terminal=False)
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    reporter = TrainingConsole()
    reporter.on_validation(10, Validation(errors(), ranking_of(np.array([0.1, 0.2]), ("a", "b"))))
    reporter.on_start(10, 100)
    for step in (11, 12, 13, 14):
        clock[0] += 4.5
        reporter.on_step(step, METRICS)
    title, one_step, rollout, ranked, *lines = output.getvalue().splitlines()
    assert title.startswith("validation at step 10, errors relative to persistence")
    assert one_step == "  one-step error        0.250; with zero actions 1.000, with shuffled actions 1.000"
    assert rollout == "  rollout error         0.500 after 1 model step, 0.500 after 3"
    assert re.fullmatch(r"  action-ranking error  15 % \[\d+, \d+\] \(0 % is best, chance 50 %\)", ranked)
    words = "loss 0.5123  lr 1.0e-04  1.50 clips/s  2.5 GB"
    expected = [f"training 11/100  {words}  0:06:40 left", f"training 14/100  {words}  0:06:27 left"]
    assert lines == expected, "first line after 4 s, then a line every 10 s"


COMMAND = "vjepa2-ac train my_robot.yaml run_dir=runs/trial training.steps=100 validation.every=50 checkpoint.every=50"
LINES = {
    "a sentence": "Warning: " + "shuffled actions change the error by 92 % only and " * 4,
    "columns": "ok       coverage         " + "motions cover most of all directions " * 4,
    "a path": f"    24 steps  /data/{'episode/' * 12} {'and its text ' * 4}",
    "a command": f"  {COMMAND}   # {'100 steps and what they are for ' * 4}",
    "a command at the end": f"{'The run is finished and evaluated. ' * 3}Next: {COMMAND}",
    "a command in a sentence": f"{'Check axes and stride. ' * 3}`{COMMAND}` {'shows both of them ' * 4}",
}


@pytest.mark.parametrize("name", LINES)
def test_texts_are_wrapped_at_100_columns_and_commands_are_not_split(name: str) -> None:
    text = LINES[name]
    lines = console_module.wrap_text(text).splitlines()
    assert len(lines) > 1
    assert all(len(line) <= 100 or COMMAND in line or line.startswith("    24 steps  /data/") for line in lines)
    assert " ".join(" ".join(lines).split()) == " ".join(text.split()), "nothing is lost"
    assert sum(COMMAND in line for line in lines) == text.count(COMMAND)
    assert not any(line.lstrip().startswith("% ") for line in lines), "a number keeps its unit"
    if name == "columns":
        assert {len(line) - len(line.lstrip()) for line in lines[1:]} == {26}, "texts are in one column"


def test_terminal_shows_one_bar_with_the_metrics(monkeypatch: pytest.MonkeyPatch) -> None:
    output = replace_console(monkeypatch, terminal=True)
    reporter = TrainingConsole()
    reporter.on_start(0, 2)
    reporter.on_step(1, METRICS)
    reporter.on_step(2, METRICS)
    reporter.__exit__()
    last = [line for line in output.getvalue().splitlines() if "training" in line][-1]
    assert "2/2" in last
    assert "loss 0.5123  lr 1.0e-04  1.50 clips/s  2.5 GB" in last


def test_training_bar_continues_after_a_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    output = replace_console(monkeypatch, terminal=True)
    reporter = TrainingConsole()
    reporter.on_start(0, 2)
    reporter.on_step(1, METRICS)
    reporter.task("validating")
    assert Work.title == "validating"
    reporter.on_validation(1, Validation(errors(), None))
    assert Work.title == "training"
    reporter.on_step(2, METRICS)
    reporter.__exit__()
    assert "2/2" in [line for line in output.getvalue().splitlines() if "training" in line][-1]


def test_task_with_a_unit_shows_its_speed_until_the_next_task_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    output = replace_console(monkeypatch, terminal=True)
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    with ConsoleReporter() as reporter:
        encoding = reporter.task("encoding frames", "frames")
        assert not output.getvalue(), "a bar appears at its first update"
        encoding(0, 96)
        clock[0] = 4.0
        encoding(48, 96)
        reporter.task("measuring")(1, 2)
        reporter.note("done")
    shown = output.getvalue()
    assert "12.0 frames/s" in [line for line in shown.splitlines() if "48/96" in line][-1]
    assert shown.rindex("frames/s") < shown.index("measuring")
    assert "done" in shown


HOSTILE = "run[lr=0.01] [/b] :smile: \x1b[31m\x1b]0;x\x07"
SHOWN = r"run[lr=0.01] [/b] :smile: \x1b[31m\x1b]0;x\x07"


@pytest.mark.parametrize("terminal", [False, True])
def test_markup_and_control_characters_in_names_are_printed_literally(
    monkeypatch: pytest.MonkeyPatch, *, terminal: bool
) -> None:
    output = io.StringIO()
    console = console_module.PlainConsole(file=output, force_terminal=terminal, width=140, color_system="standard")
    monkeypatch.setattr(console_module, "console", console)
    console.print(f"The run is in {HOSTILE}")
    table = Table(title=HOSTILE)
    table.add_column(HOSTILE)
    table.add_row(HOSTILE)
    console.print(table)
    ProgressBar(HOSTILE)(1, 1, HOSTILE)
    assert output.getvalue().count(SHOWN) >= 6, "a line, a title, a column, a cell, a bar and its text"
    assert "\x1b]" not in output.getvalue()
    assert "\x1b[31m" not in output.getvalue(), "the only colours are those of the bar"


def test_only_the_level_of_a_finding_is_coloured(monkeypatch: pytest.MonkeyPatch) -> None:
    output = io.StringIO()
    console = console_module.PlainConsole(file=output, force_terminal=True, width=140, color_system="standard")
    monkeypatch.setattr(tables, "console", console)
    tables.print_finding(Finding("error", "source", HOSTILE))
    assert output.getvalue() == f"\x1b[31merror  \x1b[0m  source           {SHOWN}\n"


def test_control_characters_in_arguments_are_escaped_in_errors(capsys) -> None:
    assert main(["train", f"{HOSTILE}.yaml"]) == 2
    assert f"error: {SHOWN}.yaml: no such file" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["train", "--no\x1b[31m", "x"])
    assert r"--no\x1b[31m" in capsys.readouterr().err
