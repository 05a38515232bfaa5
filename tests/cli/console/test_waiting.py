"""A silent command prints on stderr what it does; a command that prints, or waits for others, does not."""

import sys
import time

import pytest

from vjepa2_ac.cli.console import waiting
from vjepa2_ac.cli.console.progress import ConsoleReporter
from vjepa2_ac.cli.console.waiting import begin_work, watch_silence


class Clock:
    """Silence that a test lets pass; a printed line ends it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.silent_s, self.lines = 0.0, list[str]()
        monkeypatch.setattr(waiting, "_CHECK_S", 0.001)
        monkeypatch.setattr(waiting, "silent_s", lambda: self.silent_s)
        monkeypatch.setattr(sys, "stderr", self)

    def write(self, text: str) -> None:
        self.silent_s = 0.0
        self.lines += [text.partition(":")[0]] * (text != "\n")

    def after(self, seconds: float) -> list[str]:
        """Return the lines that a silence of some seconds brings."""
        count, self.silent_s = len(self.lines), seconds
        time.sleep(0.03)
        return self.lines[count:]


def test_each_work_is_named_after_five_seconds_of_silence_and_then_more_rarely(monkeypatch) -> None:
    clock = Clock(monkeypatch)
    with watch_silence():
        assert clock.after(4.9) == []
        assert clock.after(5.1) == ["loading libraries and model"]
        assert clock.after(14.9) == []
        assert clock.after(15.1) == ["loading libraries and model"]
        assert clock.after(59.0) == []
        assert clock.after(61.0) == ["loading libraries and model"]
        with ConsoleReporter() as reporter:
            measuring = reporter.task("measuring")
            assert clock.after(5.1) == ["measuring"]
            measuring(2, 2)
            assert clock.after(5.1) == ["work after measuring"]
        begin_work("")
        assert clock.after(1000.0) == []
    assert clock.after(1000.0) == []


def test_output_of_other_streams_than_the_own_ones_is_not_watched(capsys: pytest.CaptureFixture[str]) -> None:
    assert waiting.silent_s() == 0.0

