"""A silent command prints on stderr what it does; a command that prints, or waits for others, does not."""

import sys
import time

import pytest

from vjepa2_ac.cli import waiting
from vjepa2_ac.cli.progress import ConsoleReporter
from vjepa2_ac.cli.waiting import Work, watch_silence


class Clock:
    """Time that passes as a test says; a printed line ends the silence."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s, self.printed_s, self.lines = 100.0, 100.0, list[str]()
        monkeypatch.setattr(waiting, "_CHECK_S", 0.001)
        monkeypatch.setattr(waiting, "seconds_since_output", lambda: self.now_s - self.printed_s)
        monkeypatch.setattr(time, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(sys, "stderr", self)

    def write(self, text: str) -> None:
        self.printed_s = self.now_s
        self.lines += [text] * (text != "\n")

    def after(self, seconds: float) -> list[str]:
        """Return the lines that come after some more seconds."""
        count, self.now_s = len(self.lines), self.now_s + seconds
        time.sleep(0.02)
        return self.lines[count:]


def test_each_work_is_named_after_five_seconds_of_silence_and_then_more_rarely(monkeypatch) -> None:
    clock = Clock(monkeypatch)
    with watch_silence():
        assert clock.after(4.5) == []
        assert clock.after(0.5) == ["loading libraries and model: 5 s so far"]
        assert clock.after(14.0) == []
        assert clock.after(1.0) == ["loading libraries and model: 20 s so far"]
        assert clock.after(59.0) == []
        assert clock.after(1.0) == ["loading libraries and model: 80 s so far"]
        clock.after(30.0)
        with ConsoleReporter() as reporter:
            reporter.task("measuring")
            assert clock.after(4.0) == [], "it has not lasted 5 seconds, however long the silence"
            assert clock.after(1.0) == ["measuring: 5 s so far"]
            clock.after(30.0)
            encoding = reporter.task("encoding")
            encoding(0, 100)
            clock.now_s += 4.5
            encoding(1, 100)
            clock.printed_s = clock.now_s
            assert clock.after(9.0) == [], "the bar has printed a line, and prints the next one after 10 seconds"
            encoding(100, 100)
            reporter.task("measuring")(2, 2)
            assert clock.after(5.0) == ["finishing measuring: 5 s so far"]
        Work.begin("")
        assert clock.after(1000.0) == []
    Work.begin("nobody watches")
    assert clock.after(1000.0) == []


def test_output_of_other_streams_than_the_own_ones_is_not_watched() -> None:
    assert waiting.seconds_since_output() == 0.0
