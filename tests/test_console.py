"""A run shows how it goes: on a bar in a terminal, in lines elsewhere."""

import io
import time

import numpy as np
import pytest
from rich.console import Console

from vjepa2_ac import console as console_module
from vjepa2_ac.console import ConsoleReporter
from vjepa2_ac.evaluation.metrics import PredictionErrors

FIGURES = {"loss": 0.51234, "samples_per_second": 1.5, "data_wait_share": 0.1}


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
    return PredictionErrors(
        rollout=ones * 0.5, persistence=ones, one_step=ones[:, 0] * 0.25, one_step_zero_actions=ones[:, 0],
        one_step_shuffled_actions=ones[:, 0], one_step_persistence=ones[:, 0], episode_ids=("a", "b", "c", "d"),
    )  # fmt: skip


def test_lines_have_loss_error_speed_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    written = shown_on(monkeypatch, terminal=False)
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    reporter = ConsoleReporter()
    reporter.validated(10, errors())
    reporter.started(10, 100)
    for step in (11, 12, 13):
        now[0] += 6.0
        reporter.stepped(step, FIGURES)
    validation, *lines = written.getvalue().splitlines()
    assert validation.startswith("validation at step 10: one-step error/persistence 0.250")
    words = "loss 0.5123  error/persistence 0.250  1.50 clips/s"
    assert lines == [f"training 12/100  {words}  0:08:48 left"], "a line every 10 seconds"


@pytest.mark.parametrize(("share", "said"), [(0.2, False), (0.35, True)])
def test_waiting_for_data_is_shown_where_it_is_much(monkeypatch, share: float, *, said: bool) -> None:
    written = shown_on(monkeypatch, terminal=False)
    reporter = ConsoleReporter()
    reporter.started(0, 1)
    reporter.stepped(1, {**FIGURES, "data_wait_share": share})
    assert ("waits for data 35% of the time" in written.getvalue()) == said
    assert "left" not in written.getvalue(), "nothing is left"


def test_a_terminal_has_one_bar_with_the_same_words(monkeypatch: pytest.MonkeyPatch) -> None:
    written = shown_on(monkeypatch, terminal=True)
    reporter = ConsoleReporter()
    reporter.started(0, 2)
    reporter.stepped(1, FIGURES)
    reporter.stepped(2, {**FIGURES, "bytes_per_clip": 2.5e6})
    reporter.close()
    last = [line for line in written.getvalue().splitlines() if "training" in line][-1]
    assert "2/2" in last
    assert "loss 0.5123  1.50 clips/s  2.50 MB/clip" in last
