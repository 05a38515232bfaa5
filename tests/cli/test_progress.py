"""Progress of a run: a bar in a terminal, lines elsewhere."""

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

FIGURES = {
    "loss": 0.51234, "learning_rate": 1e-4, "samples_per_second": 1.5, "memory_gb": 2.5, "data_wait_share": 0.1,
}  # fmt: skip


def shown_on(monkeypatch: pytest.MonkeyPatch, *, terminal: bool) -> io.StringIO:
    """Let the console write where a test can read it."""
    written = io.StringIO()
    shown = Console(
        file=written, force_terminal=terminal, width=140, highlight=False, soft_wrap=True, color_system=None
    )
    monkeypatch.setattr(console_module, "console", shown)
    return written


def errors() -> PredictionErrors:
    ones = np.ones((4, 3))
    better = {("true", "rollout"): 0.5, ("true", "teacher_forced"): 0.25}
    arrays = {(way, mode, "l1"): ones * better.get((way, mode), 1.0) for way, mode in VALIDATION_PREDICTIONS}
    return PredictionErrors(("a", "b", "c", "d"), arrays)


def test_lines_have_loss_learning_rate_speed_memory_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    written = shown_on(monkeypatch, terminal=False)
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    reporter = TrainingConsole()
    reporter.on_validation(10, Validation(errors(), ranking_of(np.array([0.1, 0.2]), ("a", "b"))))
    reporter.on_start(10, 100)
    for step in (11, 12, 13, 14):
        now[0] += 4.5
        reporter.on_step(step, FIGURES)
    title, one_step, rollout, ranked, *lines = written.getvalue().splitlines()
    assert title.startswith("validation at step 10, errors relative to persistence")
    assert one_step == "  one-step error        0.250; with zero actions 1.000, with shuffled actions 1.000"
    assert rollout == "  rollout error         0.500 after 1 model step, 0.500 after 3"
    assert re.fullmatch(r"  action-ranking error  15 % \[\d+, \d+\] \(0 % is best, chance 50 %\)", ranked)
    words = "loss 0.5123  lr 1.0e-04  1.50 clips/s  2.5 GB"
    expected = [f"training 11/100  {words}  0:06:40 left", f"training 14/100  {words}  0:06:27 left"]
    assert lines == expected, "a line before 5 seconds, then one every 10"


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
def test_lines_have_at_most_100_columns_and_commands_stay_in_one_piece(name: str) -> None:
    text = LINES[name]
    lines = console_module.wrapped(text).splitlines()
    assert len(lines) > 1
    assert all(len(line) <= 100 or COMMAND in line or line.startswith("    24 steps  /data/") for line in lines)
    assert " ".join(" ".join(lines).split()) == " ".join(text.split()), "nothing is lost"
    assert sum(COMMAND in line for line in lines) == text.count(COMMAND)
    assert not any(line.lstrip().startswith("% ") for line in lines), "a number keeps its unit"
    if name == "columns":
        assert {len(line) - len(line.lstrip()) for line in lines[1:]} == {26}, "texts are in one column"


def test_a_terminal_has_one_bar_with_the_same_words(monkeypatch: pytest.MonkeyPatch) -> None:
    written = shown_on(monkeypatch, terminal=True)
    reporter = TrainingConsole()
    reporter.on_start(0, 2)
    reporter.on_step(1, FIGURES)
    reporter.on_step(2, FIGURES)
    reporter.__exit__()
    last = [line for line in written.getvalue().splitlines() if "training" in line][-1]
    assert "2/2" in last
    assert "loss 0.5123  lr 1.0e-04  1.50 clips/s  2.5 GB" in last


def test_training_bar_follows_a_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    written = shown_on(monkeypatch, terminal=True)
    reporter = TrainingConsole()
    reporter.on_start(0, 2)
    reporter.on_step(1, FIGURES)
    reporter.task("validating")
    assert Work.title == "validating"
    reporter.on_validation(1, Validation(errors(), None))
    assert Work.title == "training"
    reporter.on_step(2, FIGURES)
    reporter.__exit__()
    assert "2/2" in [line for line in written.getvalue().splitlines() if "training" in line][-1]


def test_a_task_with_a_unit_shows_its_speed_and_the_next_one_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    written = shown_on(monkeypatch, terminal=True)
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    with ConsoleReporter() as reporter:
        encoding = reporter.task("encoding frames", "frames")
        assert not written.getvalue(), "a bar begins with its work"
        encoding(0, 96)
        now[0] = 4.0
        encoding(48, 96)
        reporter.task("measuring")(1, 2)
        reporter.note("done")
    shown = written.getvalue()
    assert "12.0 frames/s" in [line for line in shown.splitlines() if "48/96" in line][-1]
    assert shown.rindex("frames/s") < shown.index("measuring")
    assert "done" in shown


HOSTILE = "run[lr=0.01] [/b] :smile: \x1b[31m\x1b]0;x\x07"
SHOWN = r"run[lr=0.01] [/b] :smile: \x1b[31m\x1b]0;x\x07"


@pytest.mark.parametrize("terminal", [False, True])
def test_no_name_is_markup_wherever_it_is_shown(monkeypatch: pytest.MonkeyPatch, *, terminal: bool) -> None:
    written = io.StringIO()
    shown = console_module.PlainConsole(file=written, force_terminal=terminal, width=140, color_system="standard")
    monkeypatch.setattr(console_module, "console", shown)
    shown.print(f"The run is in {HOSTILE}")
    table = Table(title=HOSTILE)
    table.add_column(HOSTILE)
    table.add_row(HOSTILE)
    shown.print(table)
    ProgressBar(HOSTILE)(1, 1, HOSTILE)
    assert written.getvalue().count(SHOWN) >= 6, "a line, a title, a column, a cell, a bar and its words"
    assert "\x1b]" not in written.getvalue()
    assert "\x1b[31m" not in written.getvalue(), "colours are the bar's own"


def test_a_finding_has_its_colour_and_its_name_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.StringIO()
    shown = console_module.PlainConsole(file=written, force_terminal=True, width=140, color_system="standard")
    monkeypatch.setattr(tables, "console", shown)
    tables.print_finding(Finding("error", "source", HOSTILE))
    assert written.getvalue() == f"\x1b[31merror  \x1b[0m  source           {SHOWN}\n"


def test_errors_warnings_and_words_on_the_command_line_are_shown_as_they_are(capsys) -> None:
    assert main(["train", f"{HOSTILE}.yaml"]) == 2
    assert f"error: {SHOWN}.yaml: no such file" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["train", "--no\x1b[31m", "x"])
    assert r"--no\x1b[31m" in capsys.readouterr().err
