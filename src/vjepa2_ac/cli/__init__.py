"""How is the program used from the command line? `program` parses; each command has a file of its own."""

from vjepa2_ac.cli.program import main

__all__ = ["main"]
