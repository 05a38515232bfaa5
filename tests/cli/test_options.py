"""Options with invalid or out-of-range numbers are refused with the valid range."""

import argparse
import errno
import re
import sys
from collections.abc import Callable
from dataclasses import MISSING, fields
from pathlib import Path

import pytest
import torch

from vjepa2_ac.cli import main, program, setup
from vjepa2_ac.cli.options import parsed
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.simulation.closed_loop.benchmark import BenchmarkOptions
from vjepa2_ac.simulation.recording.record import RecordingSpec

EVALUATE, SIMULATE = ["evaluate", "run"], ["simulate", "record", "folder"]
CALIBRATE = ["data", "calibrate", "config.yaml"]


@pytest.mark.parametrize(
    ("command", "option", "wrong", "needed"),
    [
        (EVALUATE, "--nodes", ["x", "2", "52", "3.5", ""], "a whole number from 3 to 51"),
        (EVALUATE, "--reach", ["x", "0", "1000", "nan", "-1"], "a number of cm above 0 and below 1000"),
        (EVALUATE, "--sensitivity-clips", ["-1", "many"], "a whole number from 0 to 1000000000"),
        (EVALUATE, "--clips", ["0", "1e3", "100000000000"], "a whole number from 1 to 1000000000"),
        (CALIBRATE, "--frames", ["1", "257", "x"], "a whole number from 2 to 256"),
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


def leaves(
    parser: argparse.ArgumentParser, words: tuple[str, ...] = ()
) -> dict[tuple[str, ...], argparse.ArgumentParser]:
    """Return the parsers of all commands, by the words that lead to each."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not inner:
        return {words: parser}
    found: dict[tuple[str, ...], argparse.ArgumentParser] = {}
    for name, one in inner[0].choices.items():
        found |= leaves(one, (*words, name))
    return found


COMMANDS = leaves(program._parser())
WITHOUT_SETTINGS = {("compare",), ("data", "converter"), ("demo",), ("init",), ("export",), ("download",), ("imagine",)}
BEHIND = {  # what each must be given, and an option with a value
    ("train",): (["c.yaml"], ["--check"]),
    ("evaluate",): (["run"], ["--clips", "3"]),
    ("data", "check"): (["c.yaml"], ["--limit", "3"]),
    ("data", "index"): (["c.yaml"], ["--rebuild"]),
    ("data", "inspect"): (["c.yaml"], ["--rows", "3"]),
    ("data", "calibrate"): (["c.yaml"], ["--limit", "3"]),
    ("encode",): (["c.yaml"], ["--out", "folder"]),
    ("decoder",): (["c.yaml"], ["--check"]),
    ("doctor",): (["c.yaml"], []),
    ("goals",): (["c.yaml"], ["--out", "folder"]),
    ("plan",): (["run"], ["--start", "a.png", "--state", "-0.1,0,0,0,0,0,0", "--goal", "b.png"]),
    ("serve",): (["run"], ["--port", "3"]),
    ("config",): (["show", "c.yaml"], []),
    ("simulate",): (["run"], ["--episodes", "3"]),
}


def test_every_command_is_known_to_take_settings_or_not() -> None:
    assert set(COMMANDS) == set(BEHIND) | WITHOUT_SETTINGS, "say of a new command which it is"


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
    told = {name: default for name, default in defaults.items() if default not in {None, MISSING}}
    assert len(told) > 1
    for name, default in told.items():
        assert re.search(rf"\({default}[;)]", helps[name]), name


@pytest.mark.parametrize("words", BEHIND, ids=" ".join)
def test_settings_may_stand_anywhere_behind_what_they_are_of(words: tuple[str, ...]) -> None:
    given, option = BEHIND[words]
    first, second = "planning.samples=64", "data.path=a=b"
    for order in ([first, second, *option], [first, *option, second], [*option, first, second]):
        options = parsed(program._parser(), [*words, *given, *order])
        assert options.overrides == [first, second], order
        assert vars(options).get("subjects", ["run"]) == ["run"]


@pytest.mark.parametrize("words", BEHIND, ids=" ".join)
def test_what_is_no_setting_is_refused(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    given, option = BEHIND[words]
    with pytest.raises(SystemExit, match="2"):
        main([*words, *given, *option, "a.b=1", "--stepz", "3"])
    assert last_line(capsys).endswith("unrecognized arguments: --stepz 3")


def test_a_folder_whose_name_looks_like_a_setting_is_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs.lr=1").mkdir()
    options = parsed(program._parser(), ["evaluate", "runs.lr=1", "runs.lr=2"])
    assert (options.subjects, options.overrides) == (["runs.lr=1"], ["runs.lr=2"])


def test_evaluate_needs_something_to_evaluate(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["evaluate", "planning.samples=64"])
    assert last_line(capsys).endswith("the following arguments are required: RUN_OR_MODEL")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["evaluate", "run", "--clips", "3", "planning.samples=64"], "no plans are asked for.*Add --planning"),
        (["evaluate", "run", "--clips", "3", "other"], "'other' is no key=value"),
        (["config", "schema", "training.steps=3"], "config schema training.steps=3"),
        (["plan", "run", "--start", "a", "--goal", "b", "--state", "1", "2", "-3"], r"'2 -3'.*in one word"),
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
        (OSError(errno.EMFILE, "Too many open files"), r"error: ulimit -n: too many open files: this process may have"),
        (MemoryError("Unable to allocate 9 TiB"), r"memory is not enough \(Unable to allocate 9 TiB\)"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: 9 bytes"), "memory is not enough"),
        (
            torch.OutOfMemoryError("CUDA out of memory. Tried\nto"),
            r"GPU's .*\(CUDA out of memory. Tried\). Set training",
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
    assert "working directory: it is gone" in capsys.readouterr().err


def last_line(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().err.splitlines()[-1]
