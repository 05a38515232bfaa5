"""The goals command: key frames of a demonstration, as goals that follow one another."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac.cli.options import (
    Commands,
    add_checkpoint,
    argument,
    as_local,
    as_model,
    as_path,
    command,
    count,
    number_between,
    read_config,
    record_of_options,
    require_overrides,
    say_places_elsewhere,
    whole_number,
)
from vjepa2_ac.errors import InputError

if TYPE_CHECKING:
    from vjepa2_ac.demonstrations.make_goals import Recording
    from vjepa2_ac.planning.session import PlanningSession

_FILMS = (".mp4", ".m4v", ".mov")


def add_to(commands: Commands) -> None:
    """Add `goals` to a parser."""
    text = (
        "Make goals of one demonstration, an episode or a film: its key frames with durations and gripper, in a folder"
        " that `plan --goals` and `simulate --goals` take, with a contact sheet."
    )
    parser = command(commands, "goals", _goals, text)
    argument(parser, "source CONFIG|VIDEO", "a config, of whose data the episode is; or a film, MP4", as_local)
    argument(parser, "overrides key=value", "of the config, such as data.camera=wrist_left", nargs="*")
    argument(parser, "--out FOLDER", "where goals.json and the images go: new or empty", as_path, required=True)
    argument(parser, "--episode ID|NUMBER", "which one: its name in the data, or its number, from 0 (0)")
    text = (
        "gripper: where it changes, the arm stops, and the end, from the states; latent: where images stop becoming"
        " more like the next goal, with --model; every N: every N-th frame (gripper; of a film latent)"
    )
    argument(parser, "--by gripper|latent|every", text, nargs="+")
    text = "that will plan: for latents, energies and the noise floor; the folder of a run, or what model.base takes"
    argument(parser, "--model RUN_OR_MODEL", text, as_model)
    add_checkpoint(parser, default=None)
    argument(parser, "--stride N", "frames of a model step (data.stride); needed of a film", count)
    argument(parser, "--apart N", "least frames from one goal to another (gripper: 4; latent: 4 model steps)", count)
    argument(parser, "--slack N", "model steps that a goal may take fewer or more (3)", whole_number(0), default=3)
    share, energy = number_between(0.0, 1.0, "the energy"), "of the energy at a goal's beginning, below which"
    argument(parser, "--share X", f"{energy} the next one follows (none: by steps only)", share)
    argument(parser, "--stop-share X", f"{energy} the last one is reached (none: an equal image)", share)
    text = "of the resting arm, for the noise floor (default: where it rests in the episode)"
    argument(parser, "--still VIDEO", text, as_path)


def _goals(options: argparse.Namespace) -> int:
    from vjepa2_ac.storage import require_new_folder, try_writing_at, user_can_write

    by, every = _way(options)
    require_overrides(options.overrides)
    require_new_folder(options.out)
    with user_can_write(options.out):
        try_writing_at(options.out)
    recording, stride = _recording(options)

    from vjepa2_ac.console.goals import goals_notes, goals_table
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.demonstrations.make_goals import Energies, KeyFrameOptions, make_goals, recording_of_film
    from vjepa2_ac.reports.figures.planning import GOALS_IMAGE, plot_goals

    still = None if options.still is None else recording_of_film(options.still)
    session = _session(options)
    chosen = record_of_options(KeyFrameOptions, options, by=by, every=every, stride=stride)
    with ConsoleReporter() as reporter:
        energies = None if session is None else Energies(session)
        made = make_goals(recording, chosen, energies, still=still, reporter=reporter)
    with user_can_write(options.out):
        written = [made.write(options.out), plot_goals(made, options.out / GOALS_IMAGE)]
    console.print(goals_table(made))
    for note in goals_notes(made):
        console.print(note)
    for path in written:
        console.print(f"  {path}")
    return 0


def _is_film(options: argparse.Namespace) -> bool:
    return Path(options.source).suffix.lower() in _FILMS


def _way(options: argparse.Namespace) -> tuple[str, int | None]:
    """Return how key frames are found, and of `every` how many frames apart; give back words that are no part of it."""
    words = [word for word in options.by or () if "=" not in word]
    options.overrides = [*options.overrides, *(word for word in options.by or () if "=" in word)]
    way, *rest = words or ["latent" if _is_film(options) else "gripper"]
    is_every = way == "every" and len(rest) == 1 and rest[0].isdecimal() and int(rest[0]) > 0
    if not is_every and (way not in {"gripper", "latent"} or rest):
        needed = "gripper, latent, or every N, with a number of frames"
        raise InputError(where="--by", found=" ".join(words), needed=needed)
    needs_model = {"--by latent": way == "latent", "--still": options.still, "--checkpoint": options.checkpoint}
    for name, given in needs_model.items():
        if given and options.model is None:
            raise InputError(where=name, found="no model", needed="--model RUN_OR_MODEL")
    if is_every and options.apart is not None:
        raise InputError(where="--apart", found="--by every N", needed="one of them: N frames are between its goals")
    return way, int(rest[0]) if is_every else None


def _recording(options: argparse.Namespace) -> tuple[Recording, int]:
    """Return the demonstration, and the frames of a model step."""
    from vjepa2_ac.demonstrations.make_goals import recording_of_episode, recording_of_film

    if _is_film(options):
        for name, given in {"--episode": options.episode, "key=value": options.overrides}.items():
            if given:
                raise InputError(where=name, found=f"{options.source}, a film", needed="a config, of whose data it is")
        if options.stride is None:
            found = "a film, which has no model steps of its own"
            fix = "Of 30 frames a second, 8 last 0.27 s, as a model step of the released weights does: --stride 8"
            raise InputError(where="--stride", found=found, needed="how many frames are a model step", fix=fix)
        return recording_of_film(Path(options.source)), options.stride
    config = read_config(options.source, options.overrides, of_run=True)
    stride = options.stride or config.data.stride
    if stride == "auto":
        found, fix = "auto", "Say how many control steps a model step has: --stride 4"
        raise InputError(where="data.stride", found=found, needed="a number", fix=fix)

    from vjepa2_ac.console.progress import ConsoleReporter
    from vjepa2_ac.reporter import INDEXING

    with ConsoleReporter() as reporter:
        return recording_of_episode(config.data, options.episode or "0", reporter.task(INDEXING)), stride


def _session(options: argparse.Namespace) -> PlanningSession | None:
    if options.model is None:
        return None
    from vjepa2_ac.planning.session import load_to_plan

    say_places_elsewhere(options.model)
    return load_to_plan(options.model, checkpoint=options.checkpoint or "selected")
