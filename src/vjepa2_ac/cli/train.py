"""The command train."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from vjepa2_ac.cli.options import Commands, add_config, argument, command, read_config, say_places_elsewhere
from vjepa2_ac.errors import InputError, printable


def add_to(commands: Commands) -> None:
    """Add `train` to a parser."""
    parser = command(
        commands,
        "train",
        _train,
        "Train an adapter (or the whole predictor) as a config says. SIGTERM, SIGINT, SIGUSR1, SIGHUP: finish the step,"
        " write a checkpoint, end with status 75; the same command goes on from there. A second signal: end at once.",
    )
    what = "a YAML config, or with --resume the folder of a run"
    add_config(parser, such_as="training.learning_rate=3e-4", what=what)
    for words, text in (
        ("--resume", "go on with the run in the folder CONFIG"),
        ("--check", "do everything that can fail and stop before the first step"),
        ("--allow-config-change", "go on with the run in run_dir though its config is another"),
    ):
        argument(parser, words, text, action="store_true")


def _train(options: argparse.Namespace) -> int:
    from vjepa2_ac.runs.folder import read_run_config

    path = Path(options.config)
    if options.resume and options.overrides:
        needed = "the run's own config, unchanged"
        raise InputError(where="command line", found="--resume with overrides", needed=needed)
    if path.is_dir() and not options.resume:
        fix = "To go on with a run, add --resume"
        raise InputError(where=options.config, found="a folder", needed="a config file", fix=fix)
    if options.resume:
        say_places_elsewhere(options.config)
    config = read_run_config(path) if options.resume else read_config(path, options.overrides, base=True)

    from vjepa2_ac.console.progress import console
    from vjepa2_ac.console.training import TrainingConsole
    from vjepa2_ac.distributed.signals import EXIT_STATUS, StoppedError
    from vjepa2_ac.training.loop import train

    speaks = os.environ.get("RANK", "0") == "0"  # one of several processes
    try:
        with TrainingConsole() as reporter:
            folder = train(config, reporter, check_only=options.check, allow_config_change=options.allow_config_change)
    except StoppedError as stopped:
        if speaks:
            print(printable(str(stopped)), file=sys.stderr)
        return EXIT_STATUS
    if speaks and not options.check:
        console.print(f"The run is in {folder}; see how good it is: vjepa2-ac evaluate {folder}")
    return 0
