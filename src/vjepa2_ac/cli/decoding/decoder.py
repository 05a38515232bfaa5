"""The decoder command: train what turns latents into images."""

from __future__ import annotations

import argparse
import sys

from vjepa2_ac.cli.options import Commands, add_config, argument, command, read_config
from vjepa2_ac.errors import printable


def add_to(commands: Commands) -> None:
    """Add `decoder` to a parser."""
    text = (
        "Train a decoder on the latents of true frames: what `imagine` and the option --decoder of other commands show"
        " images with. It belongs to the config's encoder and camera, and serves every run on them. Stopping it costs"
        " a checkpoint's distance at most: the same command goes on."
    )
    parser = command(commands, "decoder", _decoder, text)
    add_config(parser, such_as="decoder.size=medium")
    argument(parser, "--check", "do what can fail, and write nothing", action="store_true")


def _decoder(options: argparse.Namespace) -> int:
    config = read_config(options.config, options.overrides, base=True)

    from vjepa2_ac.console.decoder import held_out_table
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.decoding.decoder_folder import read_card
    from vjepa2_ac.decoding.training import train_decoder
    from vjepa2_ac.distributed.signals import EXIT_STATUS, StoppedError

    try:
        with ConsoleReporter() as reporter:
            folder = train_decoder(config, reporter, check_only=options.check)
    except StoppedError as stopped:
        print(printable(str(stopped)), file=sys.stderr)
        return EXIT_STATUS
    if options.check:
        console.print("Everything is in place: data, model, folder and disk were checked; nothing was written.")
        return 0
    card = read_card(folder)
    if card.held_out:
        console.print(held_out_table(card))
    console.print(f"See what a model imagines: vjepa2-ac imagine {config.run_dir} --decoder {folder}")
    return 0
