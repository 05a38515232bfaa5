"""The command download: the official checkpoint."""

from __future__ import annotations

import argparse
from pathlib import Path

from vjepa2_ac.cli.options import Commands, as_path, command


def add_download(commands: Commands[argparse.ArgumentParser]) -> None:
    """Add `download` to a parser."""
    parser = command(
        commands, "download", _download, "Fetch the official checkpoint (11.7 GB); goes on where it stopped."
    )
    parser.add_argument("path", metavar="PATH", type=as_path, nargs="?", default=Path("checkpoints/vjepa2-ac-vitg.pt"))
    parser.add_argument("--url", default=None, help="another address than Meta's")


def _download(options: argparse.Namespace) -> None:
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.model.checkpoints.download import OFFICIAL_URL, download

    with ConsoleReporter() as reporter:
        show = reporter.task(f"{options.path.name} (MB)")

        def progress(done: int, whole: int | None) -> None:
            show(done // 10**6, (whole or 0) // 10**6)

        download(options.url or OFFICIAL_URL, options.path, progress=progress)
    console.print(f"The checkpoint is in {options.path}")
