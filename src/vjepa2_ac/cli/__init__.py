"""The command line: `program` parses the arguments, and each command has its own file."""

from vjepa2_ac.cli.program import main

__all__ = ["main"]
