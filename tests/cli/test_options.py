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

from made_pages import _find_commands
from vjepa2_ac.cli import main, program, setup
from vjepa2_ac.cli.options import parse_arguments
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
def test_invalid_number_raises_with_the_valid_range(
    command: list[str], option: str, wrong: list[str], needed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for text in wrong:
        with pytest.raises(SystemExit, match="2"):
            main([*command, option, text])
        assert re.search(rf"error: argument {option}.*: {re.escape(repr(text))} is not {needed}$", last_line(capsys))


COMMANDS = dict(_find_commands(program._make_parser(), ()))  # by the words of each command


def example_arguments(words: tuple[str, ...]) -> list[str]:
    """Return the arguments in the example of a command's help, without redirections of the shell."""
    title, line = COMMANDS[words].format_help().splitlines()[:2]
    assert title == "example:"
    return shlex.split(line.partition(" > ")[0], comments=True)[1:]


WITH_OVERRIDES = [
    words
    for words in COMMANDS
    if hasattr(parse_arguments(program._make_parser(), example_arguments(words)), "overrides")
]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_begins_with_a_valid_example_and_fits_80_columns(words: tuple[str, ...], monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    arguments = example_arguments(words)
    assert arguments[: len(words)] == list(words)
    assert parse_arguments(program._make_parser(), arguments).handler
    assert max(map(len, COMMANDS[words].format_help().splitlines())) <= 80


def test_program_without_a_command_lists_all_commands_one_per_line(capsys: pytest.CaptureFixture[str]) -> None:
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
def test_help_states_the_defaults_of_the_dataclasses_that_options_fill(command: str, kind: type) -> None:
    """If such an option is omitted, its parsed value is None, and the dataclass defines the default."""
    helps = {action.dest: str(action.help) for action in COMMANDS[command,]._actions if action.default is None}
    defaults = {field.name: field.default for field in fields(kind) if field.name in helps}
    documented = {name: default for name, default in defaults.items() if default not in {None, MISSING, ()}}
    assert len(documented) > 1
    for name, default in documented.items():
        assert re.search(rf"\({default}[;)]", helps[name]), name


@pytest.mark.parametrize("words", WITH_OVERRIDES, ids=" ".join)
def test_overrides_are_accepted_at_any_position_after_the_positional_arguments(words: tuple[str, ...]) -> None:
    arguments, start = (
        example_arguments(words),
        len(words) + (2 if words in {("config",), ("export",), ("data", "convert")} else 1),
    )
    first, second = "planning.samples=64", "data.path=a=b"
    other_words = arguments[start:]
    for order in ([first, second, *other_words], [first, *other_words, second], [*other_words, first, second]):
        options = parse_arguments(program._make_parser(), [*arguments[:start], *order])
        assert [override for override in options.overrides if override in {first, second}] == [first, second]


@pytest.mark.parametrize("words", WITH_OVERRIDES, ids=" ".join)
def test_unknown_option_after_an_override_raises(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([*example_arguments(words), "a.b=1", "--stepz", "3"])
    assert f"vjepa2-ac {' '.join(words)}: error: unrecognized arguments: --stepz 3" in last_line(capsys)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["evaluate", "run", "--clips", "3", "planning.samples=64"],
            "planning.samples=64.*config keys cannot be changed",
        ),
        (["evaluate", "run", "--clips", "3", "other"], "'other' is not key=value"),
        (["config", "schema", "training.steps=3"], "config schema training.steps=3"),
        (["plan", "run", "--start", "a", "--goal", "b", "--state", "1", "2", "-3"], r"'2 -3'.*in one word"),
        (["trian", "c.yaml"], "'trian' is unknown. Did you mean train[?]"),
        (["data", "chek", "c.yaml"], "Did you mean check[?]"),
        (["evaluate", "run", "--split", "tset"], "Did you mean test[?]"),
        (["demo", "--plugn", "x"], "unrecognized arguments: --plugn x. Did you mean --plugin[?]"),
        (["evaluate"], "arguments are required: RUN_OR_MODEL$"),
        (["data", "calibrate", "c.yaml", "--frames", "3"], "All options: `vjepa2-ac data calibrate --help`"),
        (["qqq"], "'qqq' is unknown. Choices: demo, init, "),
        (["simulate", "run", "--episodes", "3", "samples"], "'samples'"),
        (["simulate", "record", "out", "--stepz", "3"], "unrecognized arguments: --stepz 3"),
        (["data", "check", "c.yaml", "--limit", "3", "samples"], "'samples'"),
        (["train", "c.yaml", "samples"], "no such file"),
    ],
)
def test_invalid_command_line_raises_with_a_hint(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        sys.exit(main(arguments))
    assert re.search(message, capsys.readouterr().err)


def raising(error: BaseException) -> Callable[..., int]:
    def handler(_options: object) -> int:
        raise error

    return handler


@pytest.mark.parametrize(
    ("error", "message"),
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
def test_lack_of_a_system_resource_prints_one_line(
    error: BaseException, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(setup, "_config", raising(error))
    assert main(["config", "schema"]) == 2
    assert re.search(message, capsys.readouterr().err)


def test_bug_of_the_program_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(setup, "_config", raising(RuntimeError("a bug")))
    with pytest.raises(RuntimeError, match="a bug"):
        main(["config", "schema"])


def test_missing_working_directory_raises(
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
