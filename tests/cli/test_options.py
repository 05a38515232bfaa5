"""Options with invalid or out-of-range numbers are refused with the valid range."""

import errno
import re
import shlex
import sys
from collections.abc import Callable
from dataclasses import MISSING, fields
from pathlib import Path

import pytest
import torch

from made_pages import _leaves
from vjepa2_ac.cli import main, program, setup
from vjepa2_ac.cli.options import parsed
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.simulation.benchmark import BenchmarkOptions
from vjepa2_ac.simulation.record import RecordingSpec

EVALUATE, SIMULATE = ["evaluate", "run"], ["simulate", "record", "folder"]


@pytest.mark.parametrize(
    ("command", "option", "wrong", "needed"),
    [
        (EVALUATE, "--nodes", ["x", "2", "52", "3.5", ""], "a whole number from 3 to 51"),
        (EVALUATE, "--reach", ["x", "0", "1000", "nan", "-1"], "a number of cm above 0 and below 1000"),
        (EVALUATE, "--ranking-clips", ["-1", "many"], "a whole number from 0 to 1000000000"),
        (EVALUATE, "--clips", ["0", "1e3", "100000000000"], "a whole number from 1 to 1000000000"),
        (SIMULATE, "--seed", ["x", "-1", "2147483648"], "a whole number from 0 to 2147483647"),
    ],
)
def test_an_invalid_number_is_refused_with_the_valid_range(
    command: list[str], option: str, wrong: list[str], needed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for text in wrong:
        with pytest.raises(SystemExit, match="2"):
            main([*command, option, text])
        assert re.search(rf"error: argument {option}.*: {re.escape(repr(text))} is not {needed}$", last_line(capsys))


COMMANDS = dict(_leaves(program._parser(), ()))  # by the words that lead to each


def example(words: tuple[str, ...]) -> list[str]:
    """Return what the help of a command says to type, without the program, and without what is the shell's."""
    title, line = COMMANDS[words].format_help().splitlines()[:2]
    assert title == "example:"
    return shlex.split(line.partition(" > ")[0], comments=True)[1:]


WITH_SETTINGS = [words for words in COMMANDS if hasattr(parsed(program._parser(), example(words)), "overrides")]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_begins_with_an_example_that_is_right_and_fits_80_columns(words: tuple[str, ...], monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    given = example(words)
    assert given[: len(words)] == list(words)
    assert parsed(program._parser(), given).handler
    assert max(map(len, COMMANDS[words].format_help().splitlines())) <= 80


def test_without_a_command_all_are_listed_in_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert [main([]), main(["data"])] == [2, 2]
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 80
    assert all(re.search(rf"^  {words[-1]} +[A-Z].{{20,}}[.?]$", printed, re.MULTILINE) for words in COMMANDS)


@pytest.mark.parametrize(
    ("command", "kind"),
    [
        ("evaluate", EvaluationOptions),
        ("evaluate", ProbeOptions),
        ("simulate", BenchmarkOptions),
        ("simulate", RecordingSpec),
    ],
)
def test_the_help_says_the_defaults_of_the_records_that_options_fill(command: str, kind: type) -> None:
    """An option that is not given is None: the record says what then counts."""
    helps = {action.dest: str(action.help) for action in COMMANDS[command,]._actions if action.default is None}
    defaults = {field.name: field.default for field in fields(kind) if field.name in helps}
    told = {name: default for name, default in defaults.items() if default not in {None, MISSING, ()}}
    assert len(told) > 1
    for name, default in told.items():
        assert re.search(rf"\({default}[;)]", helps[name]), name


@pytest.mark.parametrize("words", WITH_SETTINGS, ids=" ".join)
def test_settings_may_stand_anywhere_behind_what_they_are_of(words: tuple[str, ...]) -> None:
    given, behind = example(words), len(words) + (2 if words in {("config",), ("export",), ("data", "convert")} else 1)
    first, second = "planning.samples=64", "data.path=a=b"
    for order in ([first, second, *given[behind:]], [first, *given[behind:], second], [*given[behind:], first, second]):
        options = parsed(program._parser(), [*given[:behind], *order])
        assert [one for one in options.overrides if one in {first, second}] == [first, second]


@pytest.mark.parametrize("words", WITH_SETTINGS, ids=" ".join)
def test_what_is_no_setting_is_refused(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([*example(words), "a.b=1", "--stepz", "3"])
    assert f"vjepa2-ac {' '.join(words)}: error: unrecognized arguments: --stepz 3" in last_line(capsys)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["evaluate", "run", "--clips", "3", "planning.samples=64"],
            "planning.samples=64.*config keys cannot be changed",
        ),
        (["evaluate", "run", "--clips", "3", "other"], "'other' is no key=value"),
        (["config", "schema", "training.steps=3"], "config schema training.steps=3"),
        (["plan", "run", "--start", "a", "--goal", "b", "--state", "1", "2", "-3"], r"'2 -3'.*in one word"),
        (["trian", "c.yaml"], "'trian' is unknown. Did you mean train[?]"),
        (["data", "chek", "c.yaml"], "Did you mean check[?]"),
        (["evaluate", "run", "--split", "tset"], "Did you mean test[?]"),
        (["demo", "--plugn", "x"], "unrecognized arguments: --plugn x. Did you mean --plugin[?]"),
        (["qqq"], "'qqq' is unknown. Known are demo, init, "),
        (["simulate", "run", "--episodes", "3", "samples"], "'samples'"),
        (["simulate", "record", "out", "--stepz", "3"], "unrecognized arguments: --stepz 3"),
        (["data", "check", "c.yaml", "--limit", "3", "samples"], "'samples'"),
        (["train", "c.yaml", "samples"], "no such file"),
    ],
)
def test_a_word_that_does_nothing_is_refused(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        sys.exit(main(arguments))
    assert re.search(words, capsys.readouterr().err)


def raising(error: BaseException) -> Callable[..., int]:
    def handler(_options: object) -> int:
        raise error

    return handler


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            OSError(errno.EMFILE, "Too many open files"),
            r"error: ulimit -n: too many open files: the limit of this process is",
        ),
        (MemoryError("Unable to allocate 9 TiB"), r"too little memory \(Unable to allocate 9 TiB\)"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: 9 bytes"), "too little memory"),
        (
            torch.OutOfMemoryError("CUDA out of memory. Tried\nto"),
            r"the GPU has too little memory \(CUDA out of memory. Tried\). Set training",
        ),
        (OSError(errno.ENOSPC, "No space left on device", "run"), r"No space left on device: 'run'"),
    ],
)
def test_what_the_system_does_not_give_is_one_line(
    error: BaseException, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(setup, "_config", raising(error))
    assert main(["config", "schema"]) == 2
    assert re.search(words, capsys.readouterr().err)


def test_a_mistake_of_ours_is_no_error_of_the_users(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(setup, "_config", raising(RuntimeError("a mistake")))
    with pytest.raises(RuntimeError, match="a mistake"):
        main(["config", "schema"])


def test_a_missing_working_directory_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    assert main(["config", "schema"]) == 2
    assert "working directory: the folder does not exist" in capsys.readouterr().err


def last_line(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().err.splitlines()[-1]
