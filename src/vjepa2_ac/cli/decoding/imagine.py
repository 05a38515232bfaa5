"""The imagine command: what a model believes will happen, as a film."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac.cli.options import (
    NEGATIVE_NUMBERS,
    Commands,
    add_checkpoint,
    argument,
    as_local,
    as_model,
    as_numbers,
    as_path,
    camera_pose,
    command,
    count,
    load_planning_session,
    require_to_plan,
    say_places_elsewhere,
    whole_number,
)
from vjepa2_ac.errors import InputError

if TYPE_CHECKING:
    from vjepa2_ac.decoding.imagine import Imagination
    from vjepa2_ac.reporter import Reporter


def add_to(commands: Commands) -> None:
    """Add `imagine` to a parser."""
    text = (
        "Show what a model imagines from one frame of a held-out clip: under the recorded actions, beside the truth and"
        " the base, and under actions that were not taken. A strip, an MP4 and a GIF. Of data that `simulate record`"
        " made, what really happens is shown, too. A decoded image is no evidence of success: docs/decoding.md."
    )
    parser = command(commands, "imagine", _imagine, text)
    parser._negative_number_matcher = NEGATIVE_NUMBERS  # "-0.3,0.1,..." is a value, not an option
    argument(parser, "subject RUN_OR_MODEL", "folder of a run, or what model.base takes", as_model)
    argument(parser, "overrides key=value", "with --image: such as planning.limits.xyz=data", nargs="*")
    text = "what draws the images: the folder that `vjepa2-ac decoder` made, or builtin:sim-tiny"
    argument(parser, "--decoder FOLDER", text, as_model, required=True)
    text = (
        "with commas between them: true (the recorded ones of a clip), none, up, down, left, right, forward, back,"
        " open, close, in the robot's frame; or files, .npy or .csv: a row of 7 numbers for each step"
        " (true,none,up,left,close)"
    )
    argument(parser, "--actions NAMES", text)
    argument(parser, "--steps N", "model steps to imagine (7)", count, default=7)
    text = "length of a named action in each step, if planning.limits allow it (5)"
    argument(parser, "--size CM", text, float, default=5.0)
    text = "which clip, by its name in the data (default: of the split, that with the most motion)"
    argument(parser, "--episode ID", text)
    argument(parser, "--start N", "its first control step (0)", whole_number(0))
    group = parser.add_argument_group("instead of a clip")
    argument(group, "--image IMAGE", "what a camera sees: PNG or JPEG; actions by name only", as_local)
    argument(group, "--state NUMBERS", "measured then, as `plan --state`")
    argument(group, "--extrinsics NUMBERS", "the camera, as `plan --extrinsics`; where the model uses it")
    argument(group, "--config CONFIG", "for a model: the config whose planning, crop and dtype count", as_local)
    argument(parser, "--split", "of the clip (test)", choices=["test", "validation", "train"], default="test")
    argument(parser, "--data CONFIG", "clips of other data; needed for a model", as_local)
    add_checkpoint(parser)
    argument(parser, "--out FOLDER", "where the film goes (imagined, in the run's)", as_path)


def _imagine(options: argparse.Namespace) -> int:
    _require_one_start(options)
    say_places_elsewhere(options.subject)

    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.reports.imagined import write_film_of
    from vjepa2_ac.runs.folder import is_run

    home = Path(options.subject) if is_run(options.subject) else Path()
    out = options.out or home / "imagined"
    with ConsoleReporter() as reporter:
        imagination = _of_image(options) if options.image is not None else _of_clip(options, out, reporter)
        written = write_film_of(imagination, out, reporter=reporter)
    for note in imagination.notes:
        console.print(note)
    for path in written:
        console.print(f"  {path}")
    return 0


def _require_one_start(options: argparse.Namespace) -> None:
    """Refuse options that do not belong together."""
    if options.start is not None and options.episode is None:
        raise InputError(where="--start", found="no --episode", needed="the episode whose control step it is")
    if (options.image is None) != (options.state is None):
        raise InputError(where="--image, --state", found="one of them", needed="both: state and image of one moment")
    clip = {"--episode": options.episode, "--data": options.data}
    if options.image is not None and (given := [name for name, value in clip.items() if value is not None]):
        raise InputError(where="--image", found=f"{', '.join(given)}, too", needed="a clip or an image, not both")


def _words(options: argparse.Namespace) -> tuple[str, ...]:
    usual = "none,up,left,close" if options.image is not None else "true,none,up,left,close"
    return tuple(word for word in (options.actions or usual).split(",") if word)


def _of_clip(options: argparse.Namespace, out: Path, reporter: Reporter) -> Imagination:
    from vjepa2_ac.cli.options import read_config
    from vjepa2_ac.evaluation.imagined import ImagineOptions, imagine_clip
    from vjepa2_ac.evaluation.request import EvaluationOptions
    from vjepa2_ac.simulation.imagined_truth import with_what_happens

    data = None if options.data is None else read_config(options.data, of_run=True)
    asked = ImagineOptions(
        decoder=options.decoder,
        actions=_words(options),
        steps=options.steps,
        size_m=options.size / 100,
        split=options.split,
        episode=options.episode,
        start=options.start,
        evaluation=EvaluationOptions(checkpoint=options.checkpoint, data=data, out=out),
    )
    return with_what_happens(imagine_clip(options.subject, asked, reporter=reporter)).imagination


def _of_image(options: argparse.Namespace) -> Imagination:
    from vjepa2_ac.evaluation.imagined_image import Seen, imagine_image
    from vjepa2_ac.media.image_file import read_image

    state, extrinsics = as_numbers(options.state, "--state"), camera_pose(options.extrinsics)
    require_to_plan(options)
    seen = Seen(read_image(options.image), state, extrinsics)
    session, words = load_planning_session(options), _words(options)
    return imagine_image(session, options.decoder, seen, words, steps=options.steps, size_m=options.size / 100)
