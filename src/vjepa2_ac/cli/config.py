"""The command config: the schema of configs, or one with every default."""

from __future__ import annotations

import argparse
import json

from vjepa2_ac.cli.options import Commands, as_local, command
from vjepa2_ac.errors import InputError


def add_config(commands: Commands[argparse.ArgumentParser]) -> None:
    """Add `config` to a parser."""
    parser = command(commands, "config", _config, "Print the JSON schema of configs, or one config with every default.")
    parser.add_argument("what", choices=["schema", "show"])
    parser.add_argument("config", metavar="CONFIG", type=as_local, nargs="?", help="for show: a YAML config")
    parser.add_argument("overrides", nargs="*", metavar="key=value")


def _config(options: argparse.Namespace) -> None:
    from vjepa2_ac.config.loading import config_as_yaml, config_schema, load_config

    if options.what == "schema" and options.config is not None:
        raise InputError(where="command line", found=f"config schema {options.config}", needed="config schema")
    if options.what == "schema":
        print(json.dumps(config_schema(), indent=2))
    elif options.config is None:
        raise InputError(
            where="command line", found="config show without a file", needed="vjepa2-ac config show CONFIG"
        )
    else:
        print(config_as_yaml(load_config(options.config, options.overrides)), end="")
