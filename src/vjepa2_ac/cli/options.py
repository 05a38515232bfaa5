"""Shared parts of the commands: adding a subcommand, and parsing numbers."""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from vjepa2_ac import places
from vjepa2_ac.errors import InputError, printable

if TYPE_CHECKING:
    from vjepa2_ac.config import Config

Commands = argparse._SubParsersAction
Handler = Callable[[argparse.Namespace], int | None]

_MOST = 10**9
_OPTION = re.compile(r"-(?![\d.])")  # but a negative number is a value
_OVERRIDE = re.compile(r"[a-z_]+(\.\w+)+=")


class Parser(argparse.ArgumentParser):
    """A parser whose messages cannot move a terminal's cursor, whatever the arguments are."""

    def error(self, message: str) -> NoReturn:
        """Print the error, and exit with status 2."""
        super().error(printable(message))


def command(
    commands: Commands[argparse.ArgumentParser], name: str, handler: Handler, text: str
) -> argparse.ArgumentParser:
    """Add a command with its handler, and return its parser."""
    parser = commands.add_parser(name, help=text, description=text)
    parser.set_defaults(handler=handler)
    return parser


def say_places_elsewhere(subject: str) -> None:
    """Print the addresses that the config of a run names, before any of them is contacted; nothing for a model."""
    from vjepa2_ac.console.progress import console
    from vjepa2_ac.runs.folder import is_run, places_elsewhere, read_run_config

    if is_run(subject) and os.environ.get("RANK", "0") == "0":  # one of several processes
        for place in places_elsewhere(read_run_config(Path(subject))):
            console.print(f"{subject} names a place elsewhere: {place}")


def read_config(path: str | Path, overrides: Sequence[str] = (), *, base: bool = False) -> Config:
    """Read a config, and refuse one whose data set is not on this machine, before what takes seconds is imported.

    What lies elsewhere is found out later.

    Args:
        path: The YAML file.
        overrides: Such as training.steps=100.
        base: Whether `model.base` has to be there, too.

    Raises:
        InputError: The config is wrong, or one of them is not there.
    """
    from vjepa2_ac.config.loading import load_config
    from vjepa2_ac.model.base_model import find_base

    config = load_config(path, overrides)
    data = config.data.path
    if not places.is_url(data) and not Path(data).exists():
        raise InputError(
            where=f"data.path: {data}",
            found=f"no such file or folder, seen from {Path.cwd()}",
            needed="a data set",
            fix="Set data.path to the data set; docs/QUICKSTART.md says how to get DROID",
        )
    if base and config.model.base is not None:
        find_base(config.model.base)
    return config


def require_subject(subject: str, checkpoint: str | None = None) -> None:
    """Refuse a run or a model that is not there, before what takes seconds is imported.

    Args:
        subject: The folder of a run; or a model: what `model.base` takes.
        checkpoint: Of a run: newest, best, or a number of optimizer steps; None: it is not looked for.

    Raises:
        InputError: There is no such run, checkpoint or model.
    """
    from vjepa2_ac.model.base_model import find_base
    from vjepa2_ac.runs.checkpoint_selection import require_listed
    from vjepa2_ac.runs.folder import is_run, read_run_config

    if not is_run(subject):
        find_base(subject)
        return
    read_run_config(Path(subject))
    if checkpoint is not None:
        require_listed(Path(subject), checkpoint)


def require_to_plan(options: argparse.Namespace) -> Config:
    """Return the settings to plan with; refuse those that cannot be, before what takes seconds is imported.

    Raises:
        InputError: One of them is wrong or not there.
    """
    from vjepa2_ac.planning.settings import planning_settings

    config = planning_settings(options.subject, config=options.config, overrides=options.overrides)
    require_subject(options.subject, options.checkpoint)
    return config


def parsed(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse a command line; `key=value` may be anywhere after a command that takes it.

    argparse does not accept such words after an option, and treats them as unknown arguments.
    """
    options, rest = parser.parse_known_args(arguments)
    unknown = [word for word in rest if _OPTION.match(word)]
    if rest and (unknown or not hasattr(options, "overrides")):
        parser.error(f"unrecognized arguments: {' '.join(word for word in rest if not _OVERRIDE.match(word))}")
    if rest:
        options.overrides = [*options.overrides, *rest]
    return options


class SubjectsAndOverrides(argparse.Action):
    """Takes names of runs or models, one or more, and among them `key=value` words that are no folders."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, _option: str | None = None
    ) -> None:
        """Sort the words into both kinds."""
        overrides = [word for word in values if _is_override(word)]
        subjects = [word for word in values if word not in overrides]
        if not subjects:
            parser.error(f"the following arguments are required: {self.metavar}")
        setattr(namespace, self.dest, subjects)
        namespace.overrides = [*namespace.overrides, *overrides]


def as_subject(text: str) -> str:
    """Parse the name of a run or a model, and leave a `key=value` unchanged for `SubjectsAndOverrides`."""
    return text if _is_override(text) else as_model(text)


def _is_override(word: str) -> bool:
    return _OVERRIDE.match(word) is not None and not Path(word).exists()


def require_overrides(words: Sequence[str], *, fix: str = "") -> None:
    """Refuse words that are no `key=value`, before anything is read.

    Raises:
        InputError: There is one.
    """
    others = [word for word in words if "=" not in word]
    if others:
        raise InputError(
            where="command line",
            found=f"{' '.join(others)!r}",
            needed="key=value, such as training.steps=100",
            fix=fix,
        )


def as_path(text: str) -> Path:
    """Parse an option that is a path of this machine; `~` is the user's home, also after `--out=`."""
    return Path(as_local(text))


def as_local(text: str) -> str:
    """Parse a path of this machine, and keep its spelling."""
    return _meant(places.on_this_machine, text)


def as_model(text: str) -> str:
    """Parse the name of a run or a model: a path of this machine, or a model that comes with the package."""
    return _meant(places.of_a_model, text)


def whole_number(least: int, most: int | None = None) -> Callable[[str], int]:
    """Return a parser of whole numbers from `least` to `most`; None: a limit that no use reaches."""
    meant = f"a whole number from {least}" + ("" if most is None else f" to {most}")

    def read(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not {meant}") from None
        if most is None and number > _MOST:
            raise argparse.ArgumentTypeError(f"{text!r} is not {meant} to {_MOST}")
        if number < least or (most is not None and number > most):
            raise argparse.ArgumentTypeError(f"{text!r} is not {meant}")
        return number

    return read


def number_between(least: float, most: float, unit: str) -> Callable[[str], float]:
    """Return a parser of numbers with a unit, strictly between the bounds."""

    def read(text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not least < number < most:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number of {unit} above {least:g} and below {most:g}")
        return number

    return read


count = whole_number(1)  # a number of things


def _meant(read: Callable[[str], str], text: str) -> str:
    try:
        return read(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} {error}") from None
