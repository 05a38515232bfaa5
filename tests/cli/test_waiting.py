"""A command without output prints its task to stderr, unless it waits for requests."""

import sys
import time

import pytest

from vjepa2_ac.cli import waiting
from vjepa2_ac.cli.progress import ConsoleReporter
from vjepa2_ac.cli.waiting import Work, watch_silence


class Clock:
    """A clock that a test advances. It also replaces stderr: a printed line counts as output."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s, self.printed_s, self.lines = 100.0, 100.0, list[str]()
        monkeypatch.setattr(waiting, "_CHECK_S", 0.001)
        monkeypatch.setattr(waiting, "seconds_since_output", lambda: self.now_s - self.printed_s)
        monkeypatch.setattr(time, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(sys, "stderr", self)

    def write(self, text: str) -> None:
        self.printed_s = self.now_s
        self.lines += [text] * (text != "\n")

    def advance(self, seconds: float) -> list[str]:
        """Advance the time, and return the lines that are printed then."""
        count, self.now_s = len(self.lines), self.now_s + seconds
        time.sleep(0.02)
        return self.lines[count:]


def test_task_is_printed_after_5_s_without_output_and_then_less_often(monkeypatch) -> None:
    clock = Clock(monkeypatch)
    with watch_silence():
        assert clock.advance(4.5) == []
        assert clock.advance(0.5) == ["loading libraries and model: 5 s so far"]
        assert clock.advance(14.0) == []
        assert clock.advance(1.0) == ["loading libraries and model: 20 s so far"]
        assert clock.advance(59.0) == []
        assert clock.advance(1.0) == ["loading libraries and model: 80 s so far"]
        clock.advance(30.0)
        with ConsoleReporter() as reporter:
            reporter.task("measuring")
            assert clock.advance(4.0) == [], "the task began less than 5 s ago"
            assert clock.advance(1.0) == ["measuring: 5 s so far"]
            clock.advance(30.0)
            encoding = reporter.task("encoding")
            encoding(0, 100)
            clock.now_s += 4.5
            encoding(1, 100)
            clock.printed_s = clock.now_s
            assert clock.advance(9.0) == [], "the bar printed a line, and prints the next line after 10 s"
            encoding(100, 100)
            reporter.task("measuring")(2, 2)
            assert clock.advance(5.0) == ["finishing measuring: 5 s so far"]
        Work.begin("")
        assert clock.advance(1000.0) == []
    Work.begin("outside of watch_silence")
    assert clock.advance(1000.0) == []


def test_output_of_replaced_streams_is_not_measured() -> None:
    assert waiting.seconds_since_output() == 0.0
