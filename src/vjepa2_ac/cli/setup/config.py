"""The command config: the schema of configs, the configs of the package, or one with every default."""

from __future__ import annotations

import argparse
import json

from vjepa2_ac.cli.options import Commands, argument, as_local, command
from vjepa2_ac.errors import InputError

_OF_ONE = ("show", "text")


def add_to(commands: Commands) -> None:
    """Add `config` to a parser."""
    text = (
        "schema: every key with its range, as JSON schema. list: the configs that come with the package. text: one of"
        " them with its comments, to begin a config of your own with. show: a config with every default."
    )
    parser = command(commands, "config", _config, text)
    parser.add_argument("what", choices=["schema", "list", *_OF_ONE])
    argument(parser, "config CONFIG", "for show and text: a YAML config, or builtin:NAME", as_local, nargs="?")
    argument(parser, "overrides key=value", "for show: such as training.steps=100", nargs="*")


def _config(options: argparse.Namespace) -> None:
    from vjepa2_ac.config.loading import config_as_yaml, config_path, config_schema, load_config, packaged_configs

    what, where = options.what, "command line"
    if what not in _OF_ONE and options.config is not None:
        raise InputError(where=where, found=f"config {what} {options.config}", needed=f"config {what}")
    if what in _OF_ONE and options.config is None:
        raise InputError(where=where, found=f"config {what} without a file", needed=f"vjepa2-ac config {what} CONFIG")
    if what == "schema":
        print(json.dumps(config_schema(), indent=2))
    elif what == "list":
        for name, about in packaged_configs().items():
            print(f"builtin:{name:<14}{about}")
    elif what == "text":
        print(config_path(options.config).read_text(encoding="utf-8"), end="")
    else:
        print(config_as_yaml(load_config(options.config, options.overrides)), end="")
