"""Helpers shared by the commands: the argument parser, common arguments, parsers of values, and early checks."""

from __future__ import annotations

import argparse
import contextlib
import inspect
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias, TypeVar

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import expand_presets, load_config, load_config_of_run
from vjepa2_ac.errors import InputError, did_you_mean, printable, shell_command
from vjepa2_ac.process import is_first_process
from vjepa2_ac.reporter import INDEXING
from vjepa2_ac.runs.folder import is_run, list_remote_locations, read_run_config
from vjepa2_ac.storage import check_local_writable, paths, require_new_folder, translate_write_errors, write_atomically
from vjepa2_ac.storage.structured import format_json

if TYPE_CHECKING:
    import numpy as np

    from vjepa2_ac.cli.progress import ConsoleReporter
    from vjepa2_ac.data.dataset import Dataset
    from vjepa2_ac.evaluation.request import EvaluationOptions
    from vjepa2_ac.runs.subject import Subject

Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
Handler = Callable[[argparse.Namespace], int | None]

_MAX_COUNT = 10**9
_OPTION = re.compile(r"-(?![\d.])")  # a word such as -0.3 is a value, not an option
_Record = TypeVar("_Record")
_Number = TypeVar("_Number", int, float)
_Value = TypeVar("_Value")


class _Help(argparse.HelpFormatter):
    """A help formatter whose usage line omits optional options such as `--clips N`.

    Paragraphs are wrapped separately. A paragraph with indented lines is not wrapped.
    """

    def add_usage(self, usage: Any, actions: Iterable[argparse.Action], groups: Any, prefix: Any = None) -> None:
        alternatives = [action for group in groups if group.required for action in group._group_actions]
        shown = [action for action in actions if action.required or not action.option_strings or action in alternatives]
        super().add_usage(usage, shown, groups, prefix)

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(text, width, break_on_hyphens=False)  # keeps "vjepa2-ac" on one line

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = text.split("\n\n")
        filled = (text if "\n  " in text else "\n".join(self._split_lines(text, width)) for text in paragraphs)
        return textwrap.indent("\n\n".join(filled), indent)


class Parser(argparse.ArgumentParser):
    """An argument parser whose help starts with an example and whose errors suggest the closest known word.

    Control characters in its messages are escaped, and a word such as `-0.3,0.1` is read as a value, not an option.
    """

    example = ""  # arguments of the example, without the name of the command

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs, formatter_class=_Help, add_help=False)
        self.add_argument("-h", "--help", action="help", help=argparse.SUPPRESS)
        self._positionals.title = "arguments"
        self._negative_number_matcher = re.compile(r"^-[\d.]")

    def format_help(self) -> str:
        """Return the help text: the example, the usage, and the arguments."""
        example = f"example:\n  {self.prog} {self.example}\n\n" if self.example else ""
        return example + super().format_help()

    def error(self, message: str) -> NoReturn:
        """Print the error and exit with status 2."""
        super().error(printable(message))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        choices = [str(choice) for choice in action.choices or ()]
        if choices and str(value) not in choices:
            hint = did_you_mean(str(value), choices) or f"Choices: {', '.join(choices)}"
            raise argparse.ArgumentError(action, f"{value!r} is unknown. {hint.rstrip()}")


def add_command(commands: Commands, name: str, handler: Handler, example: str = "") -> Parser:
    """Add a command and return its parser.

    Args:
        commands: The subparsers of the parent parser.
        name: Name of the command.
        handler: The function that runs the command. Its docstring is the help text; the first paragraph, a short line,
            is shown in the list of commands.
        example: Arguments of the example in the help text.
    """
    text = inspect.getdoc(handler) or ""
    parser = commands.add_parser(name, help=text.partition("\n\n")[0], description=text)
    parser.example = example
    parser.epilog = "Defaults are shown in parentheses. Also: --plugin MODULE (docs/extending.md)."
    parser.set_defaults(handler=handler, parser=parser)
    add(parser, "--plugin MODULE", argparse.SUPPRESS, action="append", default=[])
    return parser


def add_commands(parser: Parser, groups: Mapping[str, Sequence[Callable[[Commands], None]]]) -> None:
    """Add groups of commands to a parser. The help lists one command per line, and is printed if no command is given.

    Args:
        parser: The parser to extend.
        groups: For each group title, functions that add commands.
    """

    def print_help(_options: argparse.Namespace) -> int:
        parser.print_help()
        return 2

    commands = parser.add_subparsers(metavar="COMMAND", help=argparse.SUPPRESS)
    for title, adders in groups.items():
        num_before = len(commands.choices)
        for add_to in adders:
            add_to(commands)
        added = list(commands.choices.items())[num_before:]
        lines = [f"  {name:<9} {(subparser.description or ' ').splitlines()[0]}" for name, subparser in added]
        if lines:
            parser.description = "\n".join([f"{parser.description}\n\n{title}:", *lines])
    parser.usage = f"{parser.prog} COMMAND ..."
    parser.set_defaults(handler=print_help, parser=parser, plugin=[])


def add(
    parser: argparse._ActionsContainer, spec: str, text: str, read: Callable[[str], Any] | None = None, **kwargs: Any
) -> None:
    """Add an argument to a parser.

    Args:
        parser: A parser or an argument group.
        spec: The name or option names, then the placeholder of the value: "config CONFIG", "--clips N".
        text: The help text. It states the default. If a dataclass defines the default, the parsed value is None.
        read: Converts the text of a value.
        kwargs: Keyword arguments of `argparse.ArgumentParser.add_argument`.
    """
    first, *rest = spec.split()
    names = [first, *(word for word in rest if word.startswith("--"))]
    metavar = next((word for word in rest if word not in names), None)
    kwargs |= {name: value for name, value in (("type", read), ("metavar", metavar)) if value is not None}
    parser.add_argument(*names, help=text, **kwargs)


def add_overrides(parser: argparse.ArgumentParser, text: str) -> None:
    """Add the `key=value` arguments, which override keys of a config."""
    add(parser, "overrides key=value", text, nargs="*", default=[])  # without a default, argparse requires one value


def add_config(parser: argparse.ArgumentParser, *, such_as: str, what: str = "a YAML config", **kwargs: Any) -> None:
    """Add the argument for a config file and the `key=value` arguments that override its keys.

    Args:
        parser: The parser.
        such_as: An override that the help shows as an example.
        what: The help text of the config argument.
        kwargs: Keyword arguments of `argparse.ArgumentParser.add_argument`, for the config argument.
    """
    add(parser, "config CONFIG", what, as_config, **kwargs)
    add_overrides(parser, f"such as {such_as} (all keys: `vjepa2-ac config schema`)")


def add_checkpoint(parser: argparse._ActionsContainer, default: str | None = "selected") -> None:
    """Add the option that selects a checkpoint of a run."""
    add(
        parser,
        "--checkpoint STEP",
        "a step number, best, newest, or selected: the best, otherwise the newest (selected)",
        default=default,
    )


def add_planner(parser: argparse.ArgumentParser, overrides_help: str) -> None:
    """Add the arguments of `load_planning_session`: run or model, overrides, checkpoint, config and extrinsics."""
    add(parser, "subject RUN_OR_MODEL", "folder of a run, or a value of model.base", as_model)
    add_overrides(parser, overrides_help)
    group = parser.add_argument_group("the model")
    add_checkpoint(group)
    add(group, "--config CONFIG", "for a model: the config with planning, crop and dtype", as_local)
    add(
        group,
        "--extrinsics NUMBERS",
        "the camera's pose x,y,z (m), roll,pitch,yaw (radians), if the model uses it",
        _camera_pose,
    )


def add_all(parser: argparse._ActionsContainer) -> None:
    """Add the option that prints all tables in addition to the summary."""
    add(parser, "--all", "also print every table and the names of the written files", action="store_true")


def add_decoder(parser: argparse._ActionsContainer, use: str, **kwargs: Any) -> None:
    """Add `--decoder`, the decoder that converts latents into images; `use` completes "which shows" in the help."""
    text = f"a decoder from `vjepa2-ac decoder`, or builtin:sim-tiny, which shows {use}"
    add(parser, "--decoder FOLDER", text, as_model, **kwargs)


def make_record(kind: Callable[..., _Record], options: argparse.Namespace, **more: Any) -> _Record:
    """Create a dataclass from parsed options: an option that is set fills the field with the same name.

    Args:
        kind: The dataclass.
        options: Parsed arguments.
        more: Values of further fields. They take precedence over options.
    """
    values = {field.name: getattr(options, field.name, None) for field in fields(kind)}  # type: ignore[arg-type]
    return kind(**{name: value for name, value in values.items() if value is not None} | more)


def make_evaluation_options(options: argparse.Namespace, **more: Any) -> EvaluationOptions:
    """Create the options of an evaluation from parsed arguments and the config of `--data`; `more` takes precedence."""
    from vjepa2_ac.evaluation.request import EvaluationOptions

    data = read_config(options.data) if options.data else None
    return make_record(EvaluationOptions, options, **({"data": data} | more))


def show(*parts: Any, files: Iterable[str | Path] = ()) -> None:
    """Print texts and tables, then one line for each written file."""
    from vjepa2_ac.cli.progress import show

    show(*parts, files=files)


def make_reporter() -> ConsoleReporter:
    """Return a reporter that prints messages and progress to the console."""
    from vjepa2_ac.cli.progress import ConsoleReporter

    return ConsoleReporter()


def report_remote_urls(subject: str) -> None:
    """Print the remote URLs in the config of a run, before any of them is contacted; print nothing for a model."""
    if is_run(subject) and is_first_process():
        for url in list_remote_locations(read_run_config(Path(subject))):
            show(f"The config of {subject} contains a URL: {url}")


def read_config(path: str | Path, overrides: Sequence[str] = (), *, base: bool = False, of_run: bool = False) -> Config:
    """Read a config and check that its local data set exists, before the slow import of PyTorch.

    A data set at a URL is not checked.

    Args:
        path: The YAML file.
        overrides: Changed keys, such as training.steps=100.
        base: Whether to check also that `model.base` and `model.encoder` exist.
        of_run: Whether the file is the config of a run.

    Raises:
        InputError: The config is invalid, or the data set or the model does not exist.
    """
    from vjepa2_ac.model.model_files import require_model

    config = load_config_of_run(Path(path), overrides) if of_run else load_config(path, overrides)
    data = config.data.path
    if not paths.is_url(data) and not Path(data).exists():
        problem = f"no such file or folder, working directory {Path.cwd()}"
        fix = "Set data.path to the data set; docs/QUICKSTART.md explains how to get DROID"
        raise InputError(where=f"data.path: {data}", found=problem, needed="a data set", fix=fix)
    if base:
        require_model(config.model)
    return config


def require_subject(subject: str, config: Config | None = None, command: Sequence[str] = ()) -> None:
    """Check that a run or model exists, before the slow import of PyTorch.

    Args:
        subject: The folder of a run, or a model in a form that `model.base` accepts.
        config: The config of the run, with the overrides of the command. None: read it from the run's folder.
        command: The arguments of the command, for the fix that the error proposes.

    Raises:
        InputError: There is no such run or model, or the base model of the run does not exist any more.
    """
    from vjepa2_ac.model.model_files import find_base, read_sizes, require_base_of_run

    if is_run(subject):
        require_base_of_run((config or read_run_config(Path(subject))).model, Path(subject), command)
    elif (base := find_base(subject)).is_dir():
        read_sizes(base)


def read_planning_config(options: argparse.Namespace) -> Config:
    """Read the config for planning, and check that the run or model exists, before the slow import of PyTorch.

    Raises:
        InputError: An override or option is invalid, or the run or model does not exist.
    """
    from vjepa2_ac.planning.settings import load_planning_config

    config = load_planning_config(options.subject, config=options.config, overrides=options.overrides)
    require_subject(options.subject, config, options.words)
    return config


def load_planning_session(options: argparse.Namespace) -> Subject:
    """Load the run or model that plans, with the options that `read_planning_config` has checked."""
    from vjepa2_ac.planning.model_setup import load_for_planning

    report_remote_urls(options.subject)
    checkpoint = options.checkpoint or "selected"
    return load_for_planning(options.subject, checkpoint=checkpoint, config=options.config, overrides=options.overrides)


def open_data(config: Config, reporter: ConsoleReporter) -> Dataset:
    """Open the data set of a config and show the progress of indexing."""
    from vjepa2_ac.data.dataset import open_dataset

    return open_dataset(config.data, progress=reporter.task(INDEXING))


def write_json(path: Path, values: Any) -> Path:
    """Write plain values to a JSON file atomically, and return its path."""
    write_atomically(path, format_json(values))
    return path


def make_folder(folder: Path) -> None:
    """Create the folder of `--out`, so that a wrong path fails before any long computation.

    Raises:
        InputError: The folder cannot be created.
    """
    with translate_write_errors(f"--out {folder}"):
        folder.mkdir(parents=True, exist_ok=True)


def require_new_path(folder: Path) -> None:
    """Check that an output folder is new or empty and can be written, before any long computation.

    Raises:
        InputError: The folder is not empty or cannot be created.
    """
    require_new_folder(folder)
    with translate_write_errors(folder):
        check_local_writable(folder)


def parse_arguments(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse a command line in which `key=value` may be at any position after a command that accepts overrides.

    argparse itself reports such words as unknown arguments if they follow an option.
    """
    options, rest = parser.parse_known_args(arguments)
    parser, non_overrides = options.parser, [word for word in rest if "=" not in word or _OPTION.match(word)]
    takes_overrides = hasattr(options, "overrides")
    if any(map(_OPTION.match, non_overrides)) or (rest and not takes_overrides):
        unknown = non_overrides if takes_overrides else rest
        hint = did_you_mean(unknown[0], parser._option_string_actions)
        parser.error(f"unrecognized arguments: {' '.join(unknown)}. {hint}All options: `{parser.prog} --help`")
    if non_overrides and vars(options).get("subject") != "record":  # the argument of `simulate record` is a folder
        words = " ".join(non_overrides)
        parser.error(f"{words!r} is not key=value (write numbers in one word, such as 0.4,0,0.3)")
    if takes_overrides:
        options.overrides = expand_presets([*options.overrides, *rest])  # a manifest refuses the keys of a preset, too
    return options


def _reader(read: Callable[[str], _Value]) -> Callable[[str], _Value]:
    """Convert a function that raises ValueError for argparse. Its message is printed after the value."""

    def read_value(text: str) -> _Value:
        try:
            return read(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r} {error}") from None

    return read_value


def _config_path(text: str) -> str:
    if paths.is_url(text):
        raise ValueError(
            f"is a URL. If the URL contains data, run `{shell_command('init', text)}`, which writes a config"
        )
    return paths.resolve_local_path(text)


as_config = _reader(_config_path)  # a local config file, or builtin:NAME
as_local = _reader(paths.resolve_local_path)  # a local path as text; `~` is the user's home folder
as_path = _reader(lambda text: Path(paths.resolve_local_path(text)))
as_path_or_url = _reader(paths.resolve_path_or_url)  # a local path or a URL
as_model = _reader(paths.resolve_model_path)  # a local path, or builtin:NAME


def whole_number(minimum: int, maximum: int = _MAX_COUNT) -> Callable[[str], int]:
    """Return a parser of integers in a range, bounds included."""
    return _numbers(int, lambda number: minimum <= number <= maximum, f"a whole number from {minimum} to {maximum}")


def number_between(lower: float, upper: float, unit: str = "") -> Callable[[str], float]:
    """Return a parser of numbers strictly between the bounds. Messages name the unit."""
    expected = f"a number {f'of {unit} ' * bool(unit)}above {lower:g} and below {upper:g}"
    return _numbers(float, lambda number: lower < number < upper, expected)


def _numbers(
    kind: Callable[[str], _Number], is_valid: Callable[[_Number], bool], expected: str
) -> Callable[[str], _Number]:
    def read(text: str) -> _Number:
        with contextlib.suppress(ValueError):
            if is_valid(number := kind(text)):
                return number
        raise argparse.ArgumentTypeError(f"{text!r} is not {expected}")

    return read


count = whole_number(1)


def _numbers_in(text: str) -> np.ndarray:
    import numpy as np

    try:
        return np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError as error:
        raise ValueError(f"is not a list of numbers separated by commas ({error})") from None


as_numbers = _reader(_numbers_in)


def _camera_pose(text: str) -> np.ndarray:
    """Parse the value of --extrinsics: x, y, z in metres, then roll, pitch, yaw in radians.

    Raises:
        InputError: The numbers are not a camera pose.
    """
    from vjepa2_ac.spaces import EXTRINSICS

    extrinsics = as_numbers(text)
    EXTRINSICS.require_state(extrinsics, "--extrinsics")
    return extrinsics


# ---- words of a recommended next command ----


def make_option_words(options: argparse.Namespace, *names: str) -> list[str]:
    """Return the command-line words that set options to their current values; defaults are left out.

    Args:
        options: Parsed arguments.
        names: The `dest` names of the options to include.
    """
    words, values = list[str](), vars(options)
    for action in options.parser._actions:
        value = values.get(action.dest)
        if action.dest in names and action.option_strings and value not in (None, action.default):
            for item in value if isinstance(value, list) else [value]:
                words += [action.option_strings[-1], str(item)]
    return words
