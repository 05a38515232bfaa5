"""Shared parts of the commands: adding a subcommand and its arguments, and what each of them may be."""

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
from vjepa2_ac.config.loading import load_config, load_config_of_run
from vjepa2_ac.config.planning import ELITES, PlanningConfig
from vjepa2_ac.errors import InputError, did_you_mean, printable, shell_command
from vjepa2_ac.process import is_first
from vjepa2_ac.reporter import INDEXING
from vjepa2_ac.runs.folder import is_run, places_elsewhere, read_run_config
from vjepa2_ac.storage import places, require_new_folder, try_writing_at, user_can_write, write_atomically
from vjepa2_ac.storage.structured import json_text

if TYPE_CHECKING:
    import numpy as np

    from vjepa2_ac.cli.progress import ConsoleReporter
    from vjepa2_ac.data.dataset import Dataset
    from vjepa2_ac.evaluation.request import EvaluationOptions
    from vjepa2_ac.runs.subject import Subject

Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
Handler = Callable[[argparse.Namespace], int | None]

QUICK = {"samples": 64, "iterations": 4}  # of `planning`, for a CPU; docs/planning.md says how good this planner is
QUICK_WORDS = tuple(f"planning.{key}={value}" for key, value in QUICK.items())
_QUICK_SEQUENCES = 256
_MOST = 10**9
_OPTION = re.compile(r"-(?![\d.])")  # but a negative number is a value
_Record = TypeVar("_Record")
_Number = TypeVar("_Number", int, float)
_Read = TypeVar("_Read")


class _Help(argparse.HelpFormatter):
    """A usage that has only what must be given; paragraphs stay apart, and one with indented lines stays as it is."""

    def add_usage(self, usage: Any, actions: Iterable[argparse.Action], groups: Any, prefix: Any = None) -> None:
        one_of = [action for group in groups if group.required for action in group._group_actions]
        given = [action for action in actions if action.required or not action.option_strings or action in one_of]
        super().add_usage(usage, given, groups, prefix)

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(text, width, break_on_hyphens=False)  # vjepa2-ac stays in one line

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        parts = text.split("\n\n")
        filled = (part if "\n  " in part else "\n".join(self._split_lines(part, width)) for part in parts)
        return textwrap.indent("\n\n".join(filled), indent)


class Parser(argparse.ArgumentParser):
    """A parser whose help begins with an example, and whose errors say what a wrong word may have meant.

    Its messages cannot move a terminal's cursor, and it takes `-0.3,0.1` for a value.
    """

    example = ""  # what stands behind its name

    def __init__(self, **how: Any) -> None:
        super().__init__(**how, formatter_class=_Help, add_help=False)
        self.add_argument("-h", "--help", action="help", help=argparse.SUPPRESS)
        self._positionals.title = "arguments"
        self._negative_number_matcher = re.compile(r"^-[\d.]")

    def format_help(self) -> str:
        """Return the example, then the usage and what can be given."""
        example = f"example:\n  {self.prog} {self.example}\n\n" if self.example else ""
        return example + super().format_help()

    def error(self, message: str) -> NoReturn:
        """Print the error, and exit with status 2."""
        super().error(printable(message))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        known = [str(one) for one in action.choices or ()]
        if known and str(value) not in known:
            hint = did_you_mean(str(value), known) or f"Known are {', '.join(known)}"
            raise argparse.ArgumentError(action, f"{value!r} is unknown. {hint.rstrip()}")


def command(commands: Commands, name: str, handler: Handler, example: str = "") -> Parser:
    """Add a command, and return its parser.

    Args:
        commands: Of a parser.
        name: What is typed.
        handler: Its docstring is the help; the first paragraph, a short line, stands in the list of commands.
        example: What is typed behind the name, in the help.
    """
    text = inspect.getdoc(handler) or ""
    parser = commands.add_parser(name, help=text.partition("\n\n")[0], description=text)
    parser.example = example
    parser.epilog = "Defaults are shown in parentheses. Also: --plugin MODULE (docs/extending.md)."
    parser.set_defaults(handler=handler, parser=parser)
    add(parser, "--plugin MODULE", argparse.SUPPRESS, action="append", default=[])
    return parser


def add_commands(parser: Parser, groups: Mapping[str, Sequence[Callable[[Commands], None]]]) -> None:
    """Give a parser commands, which its help lists in groups, a line each; without a command it is shown.

    Args:
        parser: It gets them.
        groups: By title, what adds commands.
    """

    def no_command(_options: argparse.Namespace) -> int:
        parser.print_help()
        return 2

    commands = parser.add_subparsers(metavar="COMMAND", help=argparse.SUPPRESS)
    for title, adders in groups.items():
        before = len(commands.choices)
        for add_to in adders:
            add_to(commands)
        added = list(commands.choices.items())[before:]
        lines = [f"  {name:<9} {(one.description or ' ').splitlines()[0]}" for name, one in added]
        if lines:
            parser.description = "\n".join([f"{parser.description}\n\n{title}:", *lines])
    parser.usage = f"{parser.prog} COMMAND ..."
    parser.set_defaults(handler=no_command, parser=parser, plugin=[])


def add(
    parser: argparse._ActionsContainer, words: str, text: str, read: Callable[[str], Any] | None = None, **how: Any
) -> None:
    """Add an argument to a parser.

    Args:
        parser: A parser, or a group of one.
        words: Its name, or its names if it is an option, and what its value is called: "config CONFIG", "--clips N".
        text: Its help. It says the default, also of an option that fills a record, which has None here.
        read: Reads a value.
        how: As `argparse.ArgumentParser.add_argument`.
    """
    first, *others = words.split()
    names = [first, *(word for word in others if word.startswith("--"))]
    value = next((word for word in others if word not in names), None)
    how |= {name: one for name, one in (("type", read), ("metavar", value)) if one is not None}
    parser.add_argument(*names, help=text, **how)


def add_config(parser: argparse.ArgumentParser, *, such_as: str, what: str = "a YAML config", **how: Any) -> None:
    """Add the config that a command reads, and `key=value` words behind it."""
    add(parser, "config CONFIG", what, as_config, **how)
    add(parser, "overrides key=value", f"such as {such_as} (all keys: `vjepa2-ac config schema`)", nargs="*")


def add_checkpoint(parser: argparse._ActionsContainer, default: str | None = "selected") -> None:
    """Add the option that selects a checkpoint of a run."""
    add(parser, "--checkpoint STEP", "or best, newest, selected (the best, else the newest)", default=default)


def add_planner(parser: argparse.ArgumentParser, *, such_as: str) -> None:
    """Add the run or the model that plans, `key=value` words behind it, and what else a `planning_session` is of."""
    add(parser, "subject RUN_OR_MODEL", "folder of a run, or what model.base takes", as_model)
    add(parser, "overrides key=value", such_as, nargs="*")
    group = parser.add_argument_group("the model")
    add_checkpoint(group)
    add(group, "--config CONFIG", "for a model: the config whose planning, crop and dtype count", as_local)
    add(group, "--extrinsics NUMBERS", "the camera's pose x,y,z,roll,pitch,yaw, if the model uses it", _camera_pose)


def add_all(parser: argparse._ActionsContainer) -> None:
    """Add the option that shows more than the answer."""
    add(parser, "--all", "print every table, too, and the files that were written", action="store_true")


def add_decoder(parser: argparse._ActionsContainer, shows: str, **how: Any) -> None:
    """Add `--decoder`, with which something is drawn."""
    add(parser, "--decoder FOLDER", f"show {shows}: of `vjepa2-ac decoder`, or builtin:sim-tiny", as_model, **how)


def record_of_options(kind: Callable[..., _Record], options: argparse.Namespace, **others: Any) -> _Record:
    """Return a record whose fields are the options of their names that were given, and others."""
    given = {field.name: getattr(options, field.name, None) for field in fields(kind)}  # type: ignore[arg-type]
    return kind(**{name: value for name, value in given.items() if value is not None} | others)


def evaluation_options(options: argparse.Namespace, **others: Any) -> EvaluationOptions:
    """Return the options of an evaluation that were given, with the config of --data, and others."""
    from vjepa2_ac.evaluation.request import EvaluationOptions

    data = read_config(options.data) if options.data else None
    return record_of_options(EvaluationOptions, options, **({"data": data} | others))


def show(*parts: Any, files: Iterable[str | Path] = ()) -> None:
    """Print texts and tables one below another, and the files that were written."""
    from vjepa2_ac.cli.progress import show

    show(*parts, files=files)


def reporter() -> ConsoleReporter:
    """Return what shows messages and progress."""
    from vjepa2_ac.cli.progress import ConsoleReporter

    return ConsoleReporter()


def say_places_elsewhere(subject: str) -> None:
    """Print the addresses that the config of a run names, before any of them is contacted; nothing for a model."""
    if is_run(subject) and is_first():
        for place in places_elsewhere(read_run_config(Path(subject))):
            show(f"{subject} names a place elsewhere: {place}")


def read_config(path: str | Path, overrides: Sequence[str] = (), *, base: bool = False, of_run: bool = False) -> Config:
    """Read a config, and refuse one whose data set is not on this machine, before what takes seconds is imported.

    What lies elsewhere is found out later.

    Args:
        path: The YAML file.
        overrides: Such as training.steps=100.
        base: Whether `model.base` and `model.encoder` have to be there, too.
        of_run: It is the config of a run, whatever else is in its folder.

    Raises:
        InputError: The config is wrong, or one of them is not there.
    """
    from vjepa2_ac.model.model_files import require_model

    config = load_config_of_run(Path(path), overrides) if of_run else load_config(path, overrides)
    data = config.data.path
    if not places.is_url(data) and not Path(data).exists():
        found = f"no such file or folder, seen from {Path.cwd()}"
        fix = "Set data.path to the data set; docs/QUICKSTART.md says how to get DROID"
        raise InputError(where=f"data.path: {data}", found=found, needed="a data set", fix=fix)
    if base:
        require_model(config.model)
    return config


def require_subject(subject: str, config: Config | None = None, command: Sequence[str] = ()) -> None:
    """Refuse a run or a model that is not there, before what takes seconds is imported.

    Args:
        subject: The folder of a run; or a model: what `model.base` takes.
        config: The config of a run, with the overrides of the command; None: as it is in the run's folder.
        command: The words of the command, if it has overrides for the run.

    Raises:
        InputError: There is no such run or model, or the base of the run is gone.
    """
    from vjepa2_ac.model.model_files import find_base, require_base_of_run

    if is_run(subject):
        require_base_of_run((config or read_run_config(Path(subject))).model, Path(subject), command)
    else:
        find_base(subject)


def require_to_plan(options: argparse.Namespace) -> Config:
    """Return the settings to plan with; refuse those that cannot be, before what takes seconds is imported.

    Raises:
        InputError: One of them is wrong or not there.
    """
    from vjepa2_ac.planning.settings import planning_settings

    config = planning_settings(options.subject, config=options.config, overrides=options.overrides)
    require_subject(options.subject, config, options.words)
    return config


def load_planning_session(options: argparse.Namespace) -> Subject:
    """Load the run or the model that plans, with the settings that `require_to_plan` has checked."""
    from vjepa2_ac.planning.model_setup import load_to_plan

    say_places_elsewhere(options.subject)
    how = {"checkpoint": options.checkpoint or "selected", "config": options.config, "overrides": options.overrides}
    return load_to_plan(options.subject, **how)


def open_data(config: Config, reporter: ConsoleReporter) -> Dataset:
    """Open the data set of a config, and show the progress."""
    from vjepa2_ac.data.dataset import open_dataset

    return open_dataset(config.data, progress=reporter.task(INDEXING))


def write_json(path: Path, values: Any) -> Path:
    """Write plain values as JSON, atomically; return the file."""
    write_atomically(path, json_text(values))
    return path


def make_folder(folder: Path) -> None:
    """Create the folder of `--out` before any long work.

    Raises:
        InputError: It cannot be.
    """
    with user_can_write(f"--out {folder}"):
        folder.mkdir(parents=True, exist_ok=True)


def require_new_place(folder: Path) -> None:
    """Refuse a folder that is not empty or could not be made, before any long work.

    Raises:
        InputError: It is one of these.
    """
    require_new_folder(folder)
    with user_can_write(folder):
        try_writing_at(folder)


def parsed(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse a command line; `key=value` may be anywhere after a command that takes it.

    argparse does not accept such words after an option, and treats them as unknown arguments.
    """
    options, rest = parser.parse_known_args(arguments)
    parser, others = options.parser, [word for word in rest if "=" not in word or _OPTION.match(word)]
    takes_keys = hasattr(options, "overrides")
    if any(map(_OPTION.match, others)) or (rest and not takes_keys):
        unknown = others if takes_keys else rest
        text = f"unrecognized arguments: {' '.join(unknown)}. {did_you_mean(unknown[0], parser._option_string_actions)}"
        parser.error(text.removesuffix(". ").rstrip())
    if others and vars(options).get("subject") != "record":  # `simulate record` takes a folder there
        parser.error(f"{' '.join(others)!r} is no key=value (numbers go in one word: 0.4,0,0.3; names side by side)")
    if rest:
        options.overrides = [*options.overrides, *rest]
    return options


def _reader(read: Callable[[str], _Read]) -> Callable[[str], _Read]:
    """Return what reads a value of an option, of what raises a ValueError whose message continues after the value."""

    def value(text: str) -> _Read:
        try:
            return read(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r} {error}") from None

    return value


def _config_path(text: str) -> str:
    if places.is_url(text):
        raise ValueError(f"is a URL. If it holds data, run `{shell_command('init', text)}`, which writes a config")
    return places.on_this_machine(text)


as_config = _reader(_config_path)  # a config of this machine, or one that comes with the package
as_local = _reader(places.on_this_machine)  # a path of this machine, in its spelling; `~` is the user's home
as_path = _reader(lambda text: Path(places.on_this_machine(text)))
as_place = _reader(places.anywhere)  # a path of this machine, or a URL
as_model = _reader(places.of_a_model)  # a path of this machine, or a model that comes with the package


def whole_number(least: int, most: int = _MOST) -> Callable[[str], int]:
    """Return a parser of whole numbers from `least` to `most`; by default a limit that no use reaches."""
    return _numbers(int, lambda number: least <= number <= most, f"a whole number from {least} to {most}")


def number_between(least: float, most: float, unit: str) -> Callable[[str], float]:
    """Return a parser of numbers with a unit, strictly between the bounds."""
    meant = f"a number of {unit} above {least:g} and below {most:g}"
    return _numbers(float, lambda number: least < number < most, meant)


def _numbers(kind: Callable[[str], _Number], fits: Callable[[_Number], bool], meant: str) -> Callable[[str], _Number]:
    def read(text: str) -> _Number:
        with contextlib.suppress(ValueError):
            if fits(number := kind(text)):
                return number
        raise argparse.ArgumentTypeError(f"{text!r} is not {meant}")

    return read


count = whole_number(1)  # a number of things


def _numbers_in(text: str) -> np.ndarray:
    import numpy as np

    try:
        return np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError as error:
        raise ValueError(f"is no list of numbers with commas between them ({error})") from None


as_numbers = _reader(_numbers_in)


def _camera_pose(text: str) -> np.ndarray:
    """Read the value of --extrinsics.

    Raises:
        InputError: It is no pose.
    """
    from vjepa2_ac.spaces import EXTRINSICS

    extrinsics = as_numbers(text)
    EXTRINSICS.require_state(extrinsics, "--extrinsics")
    return extrinsics


# ---- commands that a command recommends at its end ----


def option_words(options: argparse.Namespace, *names: str) -> list[str]:
    """Return the words of a command line that give some options their present values.

    Args:
        options: As their parser returned them.
        names: The options to include, by their destinations.
    """
    words, values = list[str](), vars(options)
    for action in options.parser._actions:
        value = values.get(action.dest)
        if action.dest in names and action.option_strings and value not in (None, action.default):
            for one in value if isinstance(value, list) else [value]:
                words += [action.option_strings[-1], str(one)]
    return words


def quick_words(words: Sequence[str], planning: PlanningConfig, *, on_cpu: bool) -> list[str]:
    """Return the overrides for the quick planner if a search on a CPU would be long; none if `words` set its size."""
    from vjepa2_ac.planning.planner import samples_of_iterations

    is_chosen = any(word.startswith(("planning.samples=", "planning.iterations=")) for word in words)
    is_sampled, elites = planning.planner.name != "gradient", planning.planner.options.get("elites", ELITES)
    is_long = is_sampled and planning.budget_s is None and sum(samples_of_iterations(planning)) > _QUICK_SEQUENCES
    return [*QUICK_WORDS] if on_cpu and is_long and not is_chosen and elites <= QUICK["samples"] else []
