"""The command download: the checkpoints that Meta has published."""

from __future__ import annotations

import argparse
from pathlib import Path

from vjepa2_ac.cli.options import Commands, argument, as_path, command

_FOLDER = Path("checkpoints")


def add_to(commands: Commands) -> None:
    """Add `download` to a parser."""
    text = (
        "Fetch a published checkpoint: Meta's world model, or an encoder of V-JEPA 2 or 2.1. It goes on where it"
        " stopped; size, and SHA-256 where it is known, are checked."
    )
    parser = command(commands, "download", _download, text)
    argument(parser, "name NAME", "as --list shows it (default: vjepa2-ac-vitg, the world model, 11.7 GB)", nargs="?")
    argument(parser, "--to PATH", "where to (default: checkpoints/NAME.pt)", as_path)
    argument(parser, "--url", "another address of the same file than Meta's")
    argument(parser, "--list", "show names, sizes and licences, and fetch nothing", action="store_true")


def _download(options: argparse.Namespace) -> None:
    from vjepa2_ac.console.downloads import published_notes, published_summary, published_table
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.model.checkpoints.download import download
    from vjepa2_ac.model.checkpoints.published import OFFICIAL, PUBLISHED, find_published
    from vjepa2_ac.places import literal

    if options.list:
        console.print(published_table(PUBLISHED))
        for note in published_notes(PUBLISHED):
            console.print(note)
        return
    known = find_published(options.name or OFFICIAL)
    path, url = options.to or _FOLDER / known.file, options.url or known.url
    console.print(published_summary(known, url))
    with ConsoleReporter() as reporter:
        download(url, path, known=known, reporter=reporter)
    console.print(f"It is in {path}. In a config:  {known.knob}: {literal(path)}")
