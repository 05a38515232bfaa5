"""The encode command: run the frozen encoder once over a data set and store its latents."""

from __future__ import annotations

import argparse
import os

from vjepa2_ac import output
from vjepa2_ac.cli.options import Commands, as_local, as_path, read_config


def add_encode(commands: Commands[argparse.ArgumentParser]) -> None:
    """Add `encode` to a parser."""
    text = (
        "Run the frozen encoder once over all frames that the clips of a config need, and cache the latents."
        " Stopping it costs the few episodes in progress at most: the same command goes on. Several processes"
        " (torchrun) share the work."
    )
    parser = commands.add_parser("encode", help=text.split(".", maxsplit=1)[0] + ".", description=text)
    parser.set_defaults(handler=_encode)
    parser.add_argument("config", metavar="CONFIG", type=as_local, help="a YAML config")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="such as data.cache_dtype=int8")
    parser.add_argument(
        "--out",
        metavar="FOLDER",
        type=as_path,
        help="folder of the cache, for data.source: latents (default: where data.cache finds it)",
    )


def _encode(options: argparse.Namespace) -> None:
    config = read_config(options.config, options.overrides, base=True)

    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.encoding.encode_dataset import encode_config
    from vjepa2_ac.reporter import SILENT

    output.never_wait()
    is_first = os.environ.get("RANK", "0") == "0"
    with ConsoleReporter() as reporter:
        encoded = encode_config(config, reporter if is_first else SILENT, out=options.out)
        if config.replay is not None and options.out is None and not config.replay.data.is_cache:
            encode_config(config.for_replay(), reporter if is_first else SILENT)
    manifest = encoded.manifest
    if manifest is None:
        console.print(f"This process has done its share; others are still at work on {encoded.folder}")
        return
    for name, reason in manifest.broken.items():
        console.print(f"left out: {name}: {reason}")
    console.print(
        f"{manifest.encoded:,} of {manifest.episodes:,} episodes, {manifest.frames:,} frames,"
        f" {manifest.bytes / 1e9:.3g} GB are in {encoded.folder}",
    )
    console.print(
        f"Train on them with data.source=latents data.path={encoded.folder}"
        if options.out
        else "Train on them with data.cache=auto",
    )
