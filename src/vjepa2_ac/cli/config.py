"""The command config: the schema of configs, or one with every default."""

from __future__ import annotations

import argparse
import json

from vjepa2_ac.cli.options import Commands, argument, as_local, command
from vjepa2_ac.errors import InputError


def add_to(commands: Commands) -> None:
    """Add `config` to a parser."""
    parser = command(commands, "config", _config, "Print the JSON schema of configs, or one config with every default.")
    parser.add_argument("what", choices=["schema", "show"])
    argument(parser, "config CONFIG", "for show: a YAML config", as_local, nargs="?")
    argument(parser, "overrides key=value", "such as training.steps=100", nargs="*")


def _config(options: argparse.Namespace) -> None:
    from vjepa2_ac.config.loading import config_as_yaml, config_schema, load_config

    is_schema, where = options.what == "schema", "command line"
    if is_schema and options.config is not None:
        raise InputError(where=where, found=f"config schema {options.config}", needed="config schema")
    if not is_schema and options.config is None:
        raise InputError(where=where, found="config show without a file", needed="vjepa2-ac config show CONFIG")
    if is_schema:
        print(json.dumps(config_schema(), indent=2))
    else:
        print(config_as_yaml(load_config(options.config, options.overrides)), end="")
