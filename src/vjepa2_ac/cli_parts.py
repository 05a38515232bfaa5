"""What do the commands of the command line have in common? How one is added, and how numbers are read."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from pathlib import Path

Commands = argparse._SubParsersAction
Handler = Callable[[argparse.Namespace], int | None]


def command(
    commands: Commands[argparse.ArgumentParser], name: str, handler: Handler, text: str
) -> argparse.ArgumentParser:
    """Add a command that a handler does, and return its parser."""
    parser = commands.add_parser(name, help=text, description=text)
    parser.set_defaults(handler=handler)
    return parser


def say_places_elsewhere(subject: str) -> None:
    """Say which addresses the config of a run names, before any of them is contacted; nothing of a model."""
    from vjepa2_ac.console import console
    from vjepa2_ac.errors import printable
    from vjepa2_ac.training.run_folder import CONFIG, places_elsewhere, read_run_config

    if (Path(subject) / CONFIG).is_file() and os.environ.get("RANK", "0") == "0":  # one of several processes
        for place in places_elsewhere(read_run_config(Path(subject))):
            console.print(printable(f"{subject} names a place elsewhere: {place}"), markup=False)


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
