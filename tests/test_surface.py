"""Public names, commands, options and config sections equal a golden file, so that each change is intentional.

After a wanted change: `python tests/test_surface.py > tests/golden/surface.txt`, and a line in CHANGELOG.md.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator

import vjepa2_ac
from paths import ROOT
from vjepa2_ac.cli.program import _make_parser
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import all_keys
from vjepa2_ac.registry import REGISTRIES

MOST_KEYS = 150


def surface() -> str:
    """Return the public names, extension points, config sections, commands and options, as text."""
    parts = {
        "Public names of vjepa2_ac": sorted(vjepa2_ac.__all__),
        "Extension points (entry points and plug-ins), with the names of this package": [
            f"{registry.group}: {', '.join(sorted(registry.names()))}".rstrip(": ") for registry in REGISTRIES
        ],
        "Top-level config keys": list(Config.model_fields),
        "Commands": list(commands(_make_parser(), "vjepa2-ac")),
    }
    return "\n\n".join("\n".join([title, *(f"  {line}" for line in lines)]) for title, lines in parts.items()) + "\n"


def commands(parser: argparse.ArgumentParser, name: str) -> Iterator[str]:
    """Yield a line for each command: its arguments, then its options."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    words = [action.metavar or action.dest for action in parser._actions if not action.option_strings]
    options = sorted(action.option_strings[-1] for action in parser._actions if action.option_strings)
    if not inner:
        yield " ".join(
            [name, *(str(word) for word in words), *(subparser for subparser in options if subparser != "--help")]
        )
    for action in inner:
        for command, subparser in action.choices.items():
            yield from commands(subparser, f"{name} {command}")


def leaf_keys() -> set[str]:
    """Return all config keys that hold a value; those of `replay.data` are those of `data`."""
    keys = {key for key in all_keys() if not key.startswith("replay.data.")}
    return {key for key in keys if not any(other.startswith(f"{key}.") for other in keys)}


def printed(subject: str) -> str:
    """Return what this file prints in a process of its own: other tests register sources and energies in this one."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    words = [sys.executable, "-W", "ignore", __file__, subject]
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stdout


def test_surface_equals_the_golden_file() -> None:
    assert printed("surface") == (ROOT / "tests/golden/surface.txt").read_text()


def test_config_has_few_keys() -> None:
    keys = printed("keys").split()
    assert len(keys) <= MOST_KEYS
    assert "data.source" in keys


if __name__ == "__main__":
    sys.stdout.write("\n".join(sorted(leaf_keys())) if sys.argv[1:] == ["keys"] else surface())
