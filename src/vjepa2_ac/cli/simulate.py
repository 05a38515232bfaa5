"""The simulate commands: record demonstrations of the simulated arm, or test a model on it in closed loop."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac import places
from vjepa2_ac.cli.options import (
    Commands,
    add_checkpoint,
    add_decoder,
    argument,
    as_local,
    as_path,
    as_planner,
    command,
    count,
    given_decoder,
    is_server,
    load_planning_session,
    record_of_options,
    require_to_plan,
    whole_number,
)
from vjepa2_ac.errors import InputError

if TYPE_CHECKING:
    from vjepa2_ac.simulation.closed_loop.steering import Steering

_OF_RECORD = ("cameras", "workers")
_OF_A_MODEL = ("sub_goals", "goals", "films", "decoder", "checkpoint", "config", "out")


def add_to(commands: Commands) -> None:
    """Add `simulate` to a parser: it records if its first word is `record`, else it tests a model in closed loop."""
    text = (
        "Let a model steer a simulated arm to a goal image, beside doing nothing, chance and an oracle. Or, as"
        " `simulate record FOLDER`: record demonstrations of the arm as a DROID data set. Status 1 where the model gave"
        " no finite energy in any decision."
    )
    parser = command(commands, "simulate", _simulate, text)
    text = (
        "who steers: the folder of a run, or what model.base takes, such as builtin:sim-tiny; or a server of one, as"
        " ws://127.0.0.1:8000; or: record"
    )
    argument(parser, "subject RUN_OR_MODEL|ws://SERVER|record", text, as_planner)
    text = "how it plans, such as planning.samples=64; record: where the data set goes"
    argument(parser, "overrides key=value|FOLDER", text, nargs="*")
    text = "A or B; record: or random, another world in every episode (A)"
    argument(parser, "--domain", text, default="A")
    argument(parser, "--episodes N", "how many (50; record: 40)", count)
    text = "of an episode: model steps (8; pick: 12, place: 18); record: control steps, 15/s (41; place: 81)"
    argument(parser, "--steps N", text, count)
    argument(parser, "--seed N", "which problems or demonstrations (0)", whole_number(0, 2**31 - 1))
    text = "what is to be done (reach); record: push, pick or place, with a block on the table (none: reaching around)"
    argument(parser, "--task", text, choices=["reach", "push", "pick", "place"])
    group = parser.add_argument_group("of a model that steers")
    add_checkpoint(group, default=None)
    argument(group, "--config CONFIG", "of a model: a config whose `planning` is used", as_local)
    text = (
        "goals on the way: demonstration takes them from the oracle's solution of the same problem, where the gripper"
        " changes or the arm stops; every-step: each model step of it (none)"
    )
    argument(group, "--sub-goals", text, choices=["none", "demonstration", "every-step"])
    text = "a folder of goals on the way, that `vjepa2-ac goals` made: the same in every problem, of a fixed scene"
    argument(group, "--goals FOLDER", text, as_local)
    argument(group, "--films N", "episodes in the video; 0: none (6)", whole_number(0))
    add_decoder(group, "in the video what the model imagined of each frame, one step ago")
    text = "where figures and video go (closed_loop/TASK-DOMAIN, in the run's)"
    argument(group, "--out FOLDER", text, as_path)
    argument(group, "--key-file FILE", "of a server that needs a key: the file with it", as_path)
    group = parser.add_argument_group("of record")
    argument(group, "--cameras", "1: all three images are the same one (1)", whole_number(1, 3), choices=[1, 3])
    argument(group, "--workers N", "processes; the data are the same whatever their number (1)", count)


def _simulate(options: argparse.Namespace) -> int:
    records = options.subject == "record"
    needed = "a model that steers" if records else "`simulate record FOLDER`"
    for name in _OF_A_MODEL if records else _OF_RECORD:
        if getattr(options, name) is not None:
            raise InputError(where=f"--{name.replace('_', '-')}", found=f"simulate {options.subject}", needed=needed)
    return (_record if records else _run_benchmark)(options)


def _record(options: argparse.Namespace) -> int:
    from vjepa2_ac.simulation.world.domains import named_domain
    from vjepa2_ac.storage import require_new_folder, try_writing_at, user_can_write

    if len(options.overrides) != 1:
        found = " ".join(options.overrides) or "no folder"
        raise InputError(where="simulate record", found=found, needed="one folder, where the data set goes")
    try:
        target = Path(places.on_this_machine(options.overrides[0]))
    except ValueError as error:
        found = f"{options.overrides[0]!r} {error}"
        raise InputError(where="simulate record", found=found, needed="a folder of this machine") from None
    if options.domain != "random":  # wrong words are told before what takes seconds is imported
        named_domain(options.domain)
    require_new_folder(target)
    with user_can_write(target):
        try_writing_at(target)

    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.simulation.recording.demonstration import default_steps
    from vjepa2_ac.simulation.recording.record import RecordingSpec, record_dataset

    task = None if options.task == "reach" else options.task
    spec = record_of_options(RecordingSpec, options, task=task, steps=options.steps or default_steps(task))
    episodes, workers = options.episodes or 40, options.workers or 1
    with ConsoleReporter() as reporter:
        progress = reporter.task("recording")
        progress(0, episodes)
        folder = record_dataset(target, spec, episodes=episodes, workers=workers, progress=progress)
    console.print(f"{episodes} episodes are in {folder}")
    return 0


def _run_benchmark(options: argparse.Namespace) -> int:
    from vjepa2_ac.runs.folder import is_run
    from vjepa2_ac.simulation.world.domains import named_domain

    # Wrong words are told before what takes seconds is imported.
    if options.domain == "random":
        raise InputError(where="--domain random", found="a model that steers", needed="A or B")
    named_domain(options.domain)
    if options.decoder is not None and options.films == 0:
        found, fix = "--films 0: no video in which anything could be shown", "Leave out one of the two"
        raise InputError(where=f"--decoder {options.decoder}", found=found, needed="a video", fix=fix)
    if options.goals is not None and options.sub_goals is not None:
        found = f"--sub-goals {options.sub_goals}, too"
        raise InputError(where=f"--goals {options.goals}", found=found, needed="one of the two")
    if not is_server(options.subject):
        _refuse(options, ("key_file",), needed="a server: ws://HOST:PORT")
        options.checkpoint = options.checkpoint or "selected"
        require_to_plan(options)
    else:
        _refuse(options, ("checkpoint", "config", "decoder", "overrides"), needed="the model itself; not its server")

    from vjepa2_ac.console.closed_loop import benchmark_notes, benchmark_table
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.simulation.closed_loop.benchmark import BenchmarkOptions, run_benchmark
    from vjepa2_ac.simulation.world.scene import load_mujoco

    load_mujoco()
    chosen = record_of_options(BenchmarkOptions, options)
    chosen = replace(chosen, films=min(chosen.films, chosen.episodes))
    name = f"closed_loop/{chosen.task}-{chosen.domain}"
    home = Path(options.subject) if is_run(options.subject) else Path()
    with _steering(options) as steering, ConsoleReporter() as reporter:
        benchmark, files = run_benchmark(steering, chosen, options.out or home / name, reporter)
    if benchmark.checkpoint:
        console.print(f"{options.subject}: checkpoint {benchmark.checkpoint}")
    console.print(benchmark_table(benchmark))
    for note in benchmark_notes(benchmark):
        console.print(note)
    for path in files:
        console.print(f"  {path}")
    return int(any(set(result.why_counts) == {"no finite energy"} for result in benchmark.results))


@contextmanager
def _steering(options: argparse.Namespace) -> Iterator[Steering]:
    """Return who steers; a server as long as the context lasts."""
    from vjepa2_ac.serving.access import read_key
    from vjepa2_ac.serving.client import PlanningClient
    from vjepa2_ac.simulation.closed_loop.steering import of_server, of_session

    if not is_server(options.subject):
        decoder = given_decoder(options)
        yield of_session(load_planning_session(options), decoder)
        return
    key = None if options.key_file is None else read_key(options.key_file)
    with PlanningClient(options.subject, key) as client:
        yield of_server(client)


def _refuse(options: argparse.Namespace, names: Sequence[str], *, needed: str) -> None:
    """Refuse options that mean nothing to this subject."""
    for name in names:
        if getattr(options, name):
            shown = "overrides" if name == "overrides" else f"--{name.replace('_', '-')}"
            raise InputError(where=shown, found=f"simulate {options.subject}", needed=needed)
