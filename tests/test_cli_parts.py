"""An option that is no number, or too small or large a one, is told what would do."""

import re

import pytest

from vjepa2_ac.cli import main

EVALUATE, SIMULATE = ["evaluate", "run"], ["simulate", "record", "folder"]
CALIBRATE = ["data", "calibrate", "config.yaml"]


@pytest.mark.parametrize(
    ("command", "option", "wrong", "needed"),
    [
        (EVALUATE, "--nodes", ["x", "2", "52", "3.5", ""], "a whole number from 3 to 51"),
        (EVALUATE, "--reach", ["x", "0", "1000", "nan", "-1"], "a number of cm above 0 and below 1000"),
        (EVALUATE, "--sensitivity-clips", ["-1", "many"], "a whole number from 0"),
        (EVALUATE, "--landscapes", ["-1"], "a whole number from 0"),
        (EVALUATE, "--examples", ["1e3"], "a whole number from 0"),
        (EVALUATE, "--clips", ["0", "x"], "a whole number from 1"),
        (CALIBRATE, "--frames", ["1", "257", "x"], "a whole number from 2 to 256"),
        (CALIBRATE, "--limit", ["x"], "a whole number from 1"),
        (SIMULATE, "--seed", ["x", "-1", "2147483648"], "a whole number from 0 to 2147483647"),
        (SIMULATE, "--cameras", ["x"], "a whole number from 1 to 3"),
    ],
)
def test_a_number_that_cannot_be_is_told_what_can(
    command: list[str], option: str, wrong: list[str], needed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for text in wrong:
        with pytest.raises(SystemExit, match="2"):
            main([*command, option, text])
        assert re.search(rf"error: argument {option}.*: {re.escape(repr(text))} is not {needed}$", last_line(capsys))


@pytest.mark.parametrize("number", ["3", "51"])
def test_the_bounds_themselves_are_numbers_that_can_be(number: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "no-such-run", "--nodes", number, "--sensitivity-clips", "0"]) == 2
    assert "no such folder" in last_line(capsys)


def last_line(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().err.splitlines()[-1]
