"""The encode command: run the frozen encoder once over a data set and store its latents."""

from __future__ import annotations

import argparse
import os

from vjepa2_ac.cli.options import Commands, add_config, argument, as_path, command, read_config


def add_to(commands: Commands) -> None:
    """Add `encode` to a parser."""
    text = (
        "Run the frozen encoder once over all frames that the clips of a config need, and cache the latents."
        " Stopping it costs the few episodes in progress at most: the same command goes on. Several processes"
        " (torchrun) share the work."
    )
    parser = command(commands, "encode", _encode, text)
    add_config(parser, such_as="data.cache_dtype=int8")
    text = "folder of the cache, for data.source: latents (default: where data.cache finds it)"
    argument(parser, "--out FOLDER", text, as_path)


def _encode(options: argparse.Namespace) -> None:
    config = read_config(options.config, options.overrides, base=True)

    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.encoding.encode_dataset import encode_config
    from vjepa2_ac.reporter import SILENT

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
    episodes = f"{manifest.encoded:,} of {manifest.episodes:,} episodes"
    console.print(f"{episodes}, {manifest.frames:,} frames, {manifest.bytes / 1e9:.3g} GB are in {encoded.folder}")
    knobs = f"data.source=latents data.path={encoded.folder}" if options.out else "data.cache=auto"
    console.print(f"Train on them with {knobs}")
