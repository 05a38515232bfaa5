"""The simulate commands: record demonstrations of the simulated arm, or test a model on it in closed loop."""

from __future__ import annotations

import argparse
from pathlib import Path

from vjepa2_ac import output, places
from vjepa2_ac.cli.evaluate import add_checkpoint
from vjepa2_ac.cli.options import (
    Commands,
    as_local,
    as_model,
    as_path,
    command,
    count,
    require_to_plan,
    whole_number,
)
from vjepa2_ac.errors import InputError

_RECORD = "record"
_RECORDING = {"episodes": 40, "steps": 41, "cameras": 1, "workers": 1, "task": None}
_STEERING = {
    "episodes": 50,
    "steps": None,
    "task": "reach",
    "films": 6,
    "checkpoint": "newest",
    "config": None,
    "out": None,
}


def add_simulate(commands: Commands[argparse.ArgumentParser]) -> None:
    """Add `simulate` to a parser: it records if its first word is `record`, else it tests a model in closed loop."""
    parser = command(
        commands,
        "simulate",
        _simulate,
        "Let a model steer a simulated arm to a goal image, beside doing nothing, chance and an oracle. Or, as"
        " `simulate record FOLDER`: record demonstrations of the arm as a DROID data set. Status 1 where the model gave"
        " no finite energy in any decision.",
    )
    parser.add_argument(
        "subject",
        metavar="RUN_OR_MODEL|record",
        type=as_model,
        help="who steers: the folder of a run, or what model.base takes, such as builtin:sim-tiny; or: record",
    )
    parser.add_argument(
        "overrides",
        metavar="key=value|FOLDER",
        nargs="*",
        help="how it plans, such as planning.samples=64; record: where the data set goes",
    )
    parser.add_argument("--domain", default="A", help="A or B; record: or random, another world in every episode")
    parser.add_argument("--episodes", type=count, help="how many (50; record: 40)")
    parser.add_argument("--steps", type=count, help="of an episode: model steps (8); record: control steps, 15/s (41)")
    parser.add_argument("--seed", type=whole_number(0, 2**31 - 1), default=0, help="which problems or demonstrations")
    parser.add_argument(
        "--renderer", choices=["rays", "opengl"], default="rays", help="opengl needs a working MUJOCO_GL"
    )
    parser.add_argument(
        "--task",
        choices=["reach", "push", "pick"],
        help="what is to be done (reach); record: push or pick, with a block on the table (none: reaching around)",
    )
    _add_steering(parser.add_argument_group("of a model that steers"))
    recording = parser.add_argument_group("of record")
    recording.add_argument(
        "--cameras", type=whole_number(1, 3), choices=[1, 3], help="1: all three images are the same one (1)"
    )
    recording.add_argument("--workers", type=count, help="processes; the data are the same whatever their number (1)")
    parser.set_defaults(checkpoint=None)


def _add_steering(group: argparse._ArgumentGroup) -> None:
    add_checkpoint(group)
    group.add_argument(
        "--config", metavar="CONFIG", type=as_local, help="of a model: a config whose `planning` is used"
    )
    group.add_argument("--films", metavar="N", type=whole_number(0), help="episodes in the video; 0: none (6)")
    group.add_argument(
        "--out",
        metavar="FOLDER",
        type=as_path,
        help="where figures and video go (closed_loop/TASK-DOMAIN, in the run's)",
    )


def _simulate(options: argparse.Namespace) -> int:
    records = options.subject == _RECORD
    ours, others = (_RECORDING, _STEERING) if records else (_STEERING, _RECORDING)
    for name in others.keys() - ours.keys():
        if getattr(options, name) is not None:
            raise InputError(
                where=f"--{name}",
                found=f"simulate {options.subject}",
                needed="a model that steers" if records else "`simulate record FOLDER`",
            )
    for name, default in ours.items():
        if getattr(options, name) is None:
            setattr(options, name, default)
    return (_record if records else _steer)(options)


def _record(options: argparse.Namespace) -> int:
    from vjepa2_ac.simulation.world.domains import named_domain
    from vjepa2_ac.storage import require_new_folder, try_writing_at, user_can_write

    if len(options.overrides) != 1:
        found = " ".join(options.overrides) or "no folder"
        raise InputError(where="simulate record", found=found, needed="one folder, where the data set goes")
    try:
        target = Path(places.on_this_machine(options.overrides[0]))
    except ValueError as error:
        raise InputError(
            where="simulate record", found=f"{options.overrides[0]!r} {error}", needed="a folder of this machine"
        ) from None
    if options.domain != "random":  # wrong words are told before what takes seconds is imported
        named_domain(options.domain)
    require_new_folder(target)
    with user_can_write(target):
        try_writing_at(target)

    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.simulation.recording.record import RecordingSpec, record_dataset

    output.never_wait()
    spec = RecordingSpec(
        options.domain,
        steps=options.steps,
        seed=options.seed,
        cameras=options.cameras,
        renderer=options.renderer,
        task=None if options.task == "reach" else options.task,
    )
    with ConsoleReporter() as reporter:
        progress = reporter.task("recording")
        progress(0, options.episodes)
        folder = record_dataset(target, spec, episodes=options.episodes, workers=options.workers, progress=progress)
    console.print(f"{options.episodes} episodes are in {folder}")
    return 0


def _steer(options: argparse.Namespace) -> int:
    from vjepa2_ac.runs.folder import is_run
    from vjepa2_ac.simulation.world.domains import named_domain

    # Wrong words are told before what takes seconds is imported.
    if options.domain == "random":
        raise InputError(where="--domain random", found="a model that steers", needed="A or B")
    named_domain(options.domain)
    require_to_plan(options)

    from vjepa2_ac.console.closed_loop import benchmark_notes, benchmark_table
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.planning.session import load_to_plan
    from vjepa2_ac.runs.own_files import refuse_links_out
    from vjepa2_ac.simulation.closed_loop.benchmark import BenchmarkOptions, run_benchmark
    from vjepa2_ac.simulation.world.scene import load_mujoco

    load_mujoco()
    chosen = BenchmarkOptions(
        task=options.task,
        domain=options.domain,
        episodes=options.episodes,
        steps=options.steps,
        seed=options.seed,
        films=min(options.films, options.episodes),
        renderer=options.renderer,
    )
    session = load_to_plan(
        options.subject, checkpoint=options.checkpoint, config=options.config, overrides=options.overrides
    )
    name = f"closed_loop/{chosen.task}-{chosen.domain}"
    if options.out is None and is_run(options.subject):
        refuse_links_out(Path(options.subject), [name])
    home = Path(options.subject) if is_run(options.subject) else Path()
    folder = options.out or home / name
    with ConsoleReporter() as reporter:
        benchmark, files = run_benchmark(session, chosen, folder, reporter)
    if session.checkpoint:
        console.print(f"{options.subject}: checkpoint {session.checkpoint}")
    console.print(benchmark_table(benchmark))
    for note in benchmark_notes(benchmark):
        console.print(note)
    for path in files:
        console.print(f"  {path}")
    return int(any(set(result.why_counts) == {"no finite energy"} for result in benchmark.results))
