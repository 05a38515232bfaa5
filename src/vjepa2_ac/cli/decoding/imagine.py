"""The imagine command: what a model believes will happen, as a film."""

from __future__ import annotations

import argparse
from pathlib import Path

from vjepa2_ac import output
from vjepa2_ac.cli.options import (
    Commands,
    add_checkpoint,
    argument,
    as_local,
    as_model,
    as_path,
    command,
    count,
    say_places_elsewhere,
    whole_number,
)


def add_to(commands: Commands) -> None:
    """Add `imagine` to a parser."""
    text = (
        "Show what a model imagines from one frame of a held-out clip: under the recorded actions, beside the truth and"
        " the base, and under actions that were not taken. A strip, an MP4 and a GIF. Of data that `simulate record`"
        " made, what really happens is shown, too. A decoded image is no evidence of success: docs/decoding.md."
    )
    parser = command(commands, "imagine", _imagine, text)
    argument(parser, "subject RUN_OR_MODEL", "folder of a run, or what model.base takes", as_model)
    text = "what draws the images: the folder that `vjepa2-ac decoder` made, or builtin:sim-tiny"
    argument(parser, "--decoder FOLDER", text, as_model, required=True)
    text = (
        "with commas between them: true (the recorded ones), none, up, down, left, right, forward, back, open, close,"
        " in the robot's frame; or files, .npy or .csv, a row of 7 numbers for each step (true,none,up,left,close)"
    )
    argument(parser, "--actions NAMES", text, default="true,none,up,left,close")
    argument(parser, "--steps N", "model steps to imagine (7)", count, default=7)
    text = "length of a named action in each step, if planning.limits allow it (5)"
    argument(parser, "--size CM", text, float, default=5.0)
    text = "which clip, by its name in the data (default: of the split, that with the most motion)"
    argument(parser, "--episode ID", text)
    argument(parser, "--start N", "its first control step (0)", whole_number(0))
    argument(parser, "--split", "of the clip (test)", choices=["test", "validation", "train"], default="test")
    argument(parser, "--data CONFIG", "clips of other data; needed for a model", as_local)
    add_checkpoint(parser)
    argument(parser, "--out FOLDER", "where the film goes (imagined, in the run's)", as_path)


def _imagine(options: argparse.Namespace) -> int:
    if options.start is not None and options.episode is None:
        from vjepa2_ac.errors import InputError

        raise InputError(where="--start", found="no --episode", needed="the episode whose control step it is")
    say_places_elsewhere(options.subject)

    from vjepa2_ac.cli.options import read_config
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.evaluation.imagined import ImagineOptions, imagine_clip
    from vjepa2_ac.evaluation.request import EvaluationOptions
    from vjepa2_ac.reports.imagined import write_film_of
    from vjepa2_ac.runs.folder import is_run
    from vjepa2_ac.simulation.imagined_truth import with_what_happens

    output.never_wait()
    home = Path(options.subject) if is_run(options.subject) else Path()
    out = options.out or home / "imagined"
    data = None if options.data is None else read_config(options.data)
    asked = ImagineOptions(
        decoder=options.decoder,
        actions=tuple(word for word in options.actions.split(",") if word),
        steps=options.steps,
        size_m=options.size / 100,
        split=options.split,
        episode=options.episode,
        start=options.start,
        evaluation=EvaluationOptions(checkpoint=options.checkpoint, data=data, out=out),
    )
    with ConsoleReporter() as reporter:
        film = with_what_happens(imagine_clip(options.subject, asked, reporter=reporter))
        written = write_film_of(film.imagination, out, reporter=reporter)
    for note in film.imagination.notes:
        console.print(note)
    for path in written:
        console.print(f"  {path}")
    return 0
