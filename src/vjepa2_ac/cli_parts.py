"""What do the commands of the command line have in common? How one is added, and how numbers are read."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from vjepa2_ac import places
from vjepa2_ac.output import printable

Commands = argparse._SubParsersAction
Handler = Callable[[argparse.Namespace], int | None]


class Parser(argparse.ArgumentParser):
    """A parser whose messages cannot move a terminal's cursor, whatever was given."""

    def error(self, message: str) -> NoReturn:
        """Print what is wrong, and end with status 2."""
        super().error(printable(message))


def command(
    commands: Commands[argparse.ArgumentParser], name: str, handler: Handler, text: str
) -> argparse.ArgumentParser:
    """Add a command that a handler does, and return its parser."""
    parser = commands.add_parser(name, help=text, description=text)
    parser.set_defaults(handler=handler)
    return parser


def as_path(text: str) -> Path:
    """Read an option that is a path of this machine; `~` is the user's home, also behind `--out=`."""
    return Path(as_local(text))


def as_local(text: str) -> str:
    """Read a path of this machine, and keep it as it was written."""
    return _meant(places.on_this_machine, text)


def as_model(text: str) -> str:
    """Read what names a run or a model: a path of this machine, or a model that comes with the package."""
    return _meant(places.of_a_model, text)


def whole_number(least: int, most: int | None = None) -> Callable[[str], int]:
    """Return what reads an option that is a whole number from `least` to `most`."""
    meant = f"a whole number from {least}" + ("" if most is None else f" to {most}")

    def read(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not {meant}") from None
        if number < least or (most is not None and number > most):
            raise argparse.ArgumentTypeError(f"{text!r} is not {meant}")
        return number

    return read


def number_between(least: float, most: float, unit: str) -> Callable[[str], float]:
    """Return what reads an option that is a number of some unit; the bounds themselves are not among them."""

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
