"""What do the commands of the command line have in common? How one is added, and how a number of things is read."""

from __future__ import annotations

import argparse
from collections.abc import Callable

Commands = argparse._SubParsersAction
Handler = Callable[[argparse.Namespace], int | None]


def command(
    commands: Commands[argparse.ArgumentParser], name: str, handler: Handler, text: str
) -> argparse.ArgumentParser:
    """Add a command that a handler does, and return its parser."""
    parser = commands.add_parser(name, help=text, description=text)
    parser.set_defaults(handler=handler)
    return parser


def count(text: str) -> int:
    """Read a number of things: a whole number from 1."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number} is not a whole number from 1")
    return number
