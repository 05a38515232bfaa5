"""The command export."""

from __future__ import annotations

import argparse

from vjepa2_ac.cli.options import Commands, add_checkpoint, argument, as_path, command


def add_to(commands: Commands) -> None:
    """Add `export` to a parser."""
    text = "Write a run's model, adapter merged in, or its adapter, for others to use."
    parser = command(commands, "export", _export, text)
    argument(parser, "run RUN", "the folder of a run", as_path)
    argument(parser, "folder FOLDER", "where to, new or empty; official: or a .pt file", as_path)
    text = (
        "merged: a folder that `model.base` takes. official: one .pt by Meta's names, for the official code. hub: the"
        " adapter in PEFT's format with a model card, ready to upload"
    )
    argument(parser, "--to", text, choices=["merged", "official", "hub"], default="merged")
    add_checkpoint(parser)


def _export(options: argparse.Namespace) -> None:
    from vjepa2_ac.runs.checkpoint import require_listed
    from vjepa2_ac.runs.folder import read_run_config

    read_run_config(options.run)  # wrong words are told before what takes seconds is imported
    require_listed(options.run, options.checkpoint)

    from vjepa2_ac.console.progress import console
    from vjepa2_ac.export import export_run

    written = export_run(options.run, options.folder, options.to, options.checkpoint)
    what = {"merged": "merged model", "official": "official checkpoint", "hub": "adapter with its model card"}
    console.print(f"The {what[options.to]} of checkpoint {written.checkpoint} is in {written.path}")
    if options.to == "hub":
        console.print("The card names base and data by their paths on this machine: read it before you upload it.")
