"""The command download: the official checkpoint."""

from __future__ import annotations

import argparse
from pathlib import Path

from vjepa2_ac.cli.options import Commands, argument, as_path, command


def add_to(commands: Commands) -> None:
    """Add `download` to a parser."""
    text = "Fetch the official checkpoint (11.7 GB); goes on where it stopped."
    parser = command(commands, "download", _download, text)
    place = Path("checkpoints/vjepa2-ac-vitg.pt")
    argument(parser, "path PATH", f"where to ({place})", as_path, nargs="?", default=place)
    argument(parser, "--url", "another address than Meta's")


def _download(options: argparse.Namespace) -> None:
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.model.checkpoints.download import OFFICIAL_URL, download

    with ConsoleReporter() as reporter:
        show = reporter.task(f"{options.path.name} (MB)")

        def progress(done: int, whole: int | None) -> None:
            show(done // 10**6, (whole or 0) // 10**6)

        download(options.url or OFFICIAL_URL, options.path, progress=progress)
    console.print(f"The checkpoint is in {options.path}")
