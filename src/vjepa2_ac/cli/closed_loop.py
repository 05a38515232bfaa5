"""The commands serve and simulate: planning in closed loop for a robot or a simulated arm."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac.cli import options as cli
from vjepa2_ac.cli.waiting import Work
from vjepa2_ac.errors import InputError, counted, shell_command
from vjepa2_ac.runs.folder import is_run, sets_movable_path

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

    from vjepa2_ac.evaluation.summary import Summary, Verdict
    from vjepa2_ac.reporter import Reporter
    from vjepa2_ac.runs.subject import Subject
    from vjepa2_ac.serving.metadata import NamedGoals
    from vjepa2_ac.serving.session import Session
    from vjepa2_ac.simulation.benchmark import BenchmarkOptions, ClosedLoopBenchmark
    from vjepa2_ac.simulation.manifest import Manifest, WorldManifest
    from vjepa2_ac.simulation.rollout import ClosedLoopResult
    from vjepa2_ac.simulation.worlds import ExternalEnvironment

_RECORD_OPTIONS = ("cameras", "workers")
_MANIFEST_OPTIONS = ("task", "domain", "episodes", "steps", "seed", "sub_goals")
_MODEL_OPTIONS = ("sub_goals", "manifest", "films", "checkpoint", "config", "out")


def add_serve(commands: cli.Commands) -> None:
    """Add `serve` to a parser."""
    parser = cli.add_command(commands, "serve", _serve, "demo/run --goals goals --key-file key --host 0.0.0.0")
    cli.add_planner(parser, "such as planning.limits.xyz=[0.01,0.01,0.01]")
    cli.add(
        parser,
        "--goals FOLDER",
        "goals that a client can name: images, and folders from `vjepa2-ac goals`",
        cli.as_path,
    )
    text = "delta: the change in each model step; pose: a waypoint for each control step (delta)"
    cli.add(parser, "--actions delta|pose", text, choices=["delta", "pose"], default="delta")
    cli.add(parser, "--dry-run", "plan, but send zero actions", action="store_true")
    cli.add(parser, "--record FOLDER", "write each decision with its images to a new folder, up to 2 GB", cli.as_path)
    group = parser.add_argument_group("messages")
    cli.add(group, "--image-key KEY", "key of the camera image in requests (the keys of openpi's examples)")
    seconds = cli.number_between(0, 3600, "seconds")
    cli.add(
        group,
        "--deadline SECONDS",
        "time limit of a request; a late decision is a zero action (60)",
        seconds,
        default=60.0,
    )
    group = parser.add_argument_group("access")
    cli.add(group, "--host ADDRESS", "address to listen on (127.0.0.1: this machine only)", default="127.0.0.1")
    cli.add(group, "--port N", "port; 0: any free port (8000)", cli.whole_number(0, 65535), default=8000)
    cli.add(
        group,
        "--key-file FILE",
        "file with the key that clients send; required if other machines can reach the server",
        cli.as_path,
    )
    cli.add(group, "--insecure", "allow an address that other machines can reach without a key", action="store_true")
    cli.add(group, "--allow-host NAME", "host name under which a proxy serves the server", action="append", default=[])


def add_simulate(commands: cli.Commands) -> None:
    """Add `simulate` to a parser. `simulate record` records data; otherwise a model is tested in closed loop."""
    parser = cli.add_command(commands, "simulate", _simulate, "demo/run --task reach --domain B --episodes 10")
    cli.add(parser, "subject RUN_OR_MODEL|record", "a run, a value of model.base, or the word record", cli.as_model)
    text = "such as planning.samples=64; record: the output folder"
    cli.add(parser, "overrides key=value|FOLDER", text, nargs="*", default=[])
    text = "the task (reach); record: push, pick or place with a block on the table (none: random reaching)"
    cli.add(parser, "--task", text, choices=["reach", "push", "pick", "place"])
    cli.add(
        parser,
        "--domain",
        "domain of the arm; only to record: random, a new random scene in each episode (A)",
        choices=["A", "B", "random"],
    )
    cli.add(parser, "--episodes N", "number of problems (50); record: number of episodes (40)", cli.count)
    cli.add(parser, "--steps N", "model steps (8; pick 12, place 18); record: control steps (41; place 81)", cli.count)
    cli.add(parser, "--seed N", "random seed of the problems or demonstrations (0)", cli.whole_number(0, 2**31 - 1))
    cli.add(parser, "--world COMMAND", "an environment: 'PYTHON examples/worlds/robosuite.py Lift' (docs/worlds.md)")
    seconds = cli.number_between(0, 86_400, "seconds")
    cli.add(
        parser,
        "--world-timeout SECONDS",
        "time limit of an answer from the environment; the first answer may take five times as long (120)",
        seconds,
    )
    group = parser.add_argument_group("to test a model")
    cli.add_all(group)
    cli.add_checkpoint(group, default=None)
    cli.add(group, "--config CONFIG", "for a model: the config with the section planning", cli.as_local)
    text = "sub-goals from the oracle's solution: its key frames, or every model step (none)"
    cli.add(group, "--sub-goals", text, choices=["none", "demonstration", "every-step"])
    text = "problems, steps and planning settings of a table: read from this file, or written to it if it is new"
    cli.add(group, "--manifest FILE", text, cli.as_path)
    cli.add(group, "--films N", "episodes in the video; 0: no video (6)", cli.whole_number(0))
    cli.add(group, "--out FOLDER", "output folder (closed_loop/TASK-DOMAIN in the run's folder)", cli.as_path)
    group = parser.add_argument_group("to record data")
    cli.add(
        group,
        "--cameras N",
        "number of rendered cameras, 1 to 3; further cameras repeat the first (1)",
        cli.whole_number(1, 3),
    )
    cli.add(group, "--workers N", "number of processes, which does not change the data (1)", cli.count)


def _serve(options: argparse.Namespace) -> int:
    """Serve the planner to a robot over a websocket.

    The server uses the protocol of openpi's clients. A request contains an image, a state and a goal; the reply
    contains actions within planning.limits (docs/serving.md). The command runs until SIGTERM or Ctrl-C.
    """
    from vjepa2_ac.serving.access import Access, read_key

    key = None if options.key_file is None else read_key(options.key_file)
    access = Access(options.host, key, options.insecure, tuple(options.allow_host))
    if options.goals is not None and not options.goals.is_dir():
        raise InputError(where=f"--goals {options.goals}", found="no such folder", needed="a folder with goals")
    cli.read_planning_config(options)

    from vjepa2_ac.serving.metadata import read_named_goals
    from vjepa2_ac.serving.server import serve

    if options.record is not None:
        cli.require_new_path(options.record)
    goals = None if options.goals is None else read_named_goals(options.goals)
    has_ended = serve(lambda: _load_session(options, goals), access, options.port, cli.show)
    if not has_ended:  # the planning thread still runs; its result is not needed, so do not wait for it
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return 0


def _load_session(options: argparse.Namespace, goals: NamedGoals | None) -> tuple[Session, Mapping[str, Any]]:
    """Load the model and make a first decision; return the session and the metadata for clients."""
    from vjepa2_ac.data.windows import require_stride
    from vjepa2_ac.planning.controller import Controller
    from vjepa2_ac.planning.goals import require_goal_ends
    from vjepa2_ac.policies.score import is_blind, read_run_ranking_error
    from vjepa2_ac.serving.metadata import describe_server, make_metadata, warm_up
    from vjepa2_ac.serving.recording import Recorder
    from vjepa2_ac.serving.request import IMAGE_KEYS
    from vjepa2_ac.serving.session import Session, SessionOptions

    loaded = cli.load_planning_session(options)
    steps = require_stride(
        loaded.config.data, to="compute the duration of an action", fix="Set it, for example data.stride=4"
    )
    session_options = SessionOptions(
        options.actions,
        control_steps=steps,
        image_keys=IMAGE_KEYS if options.image_key is None else (options.image_key,),
        deadline_s=options.deadline,
        dry_run=options.dry_run,
        is_blind=is_blind(read_run_ranking_error(options.subject, loaded.checkpoint_label)),
    )
    controller = Controller.of_subject(loaded, extrinsics=options.extrinsics)
    for sequence in (goals or {}).values():
        require_goal_ends(sequence, first=1)
    session = Session(controller, goals or {}, session_options)
    about = make_metadata(loaded, session)
    Work.begin("the first decision")
    cli.show(describe_server(about, options.subject), f"a first decision took {warm_up(controller):.1f} s")
    Work.begin("")
    if options.record is not None:
        server = {**about, "overrides": options.overrides, "config": options.config, **loaded.as_dict()}
        session.recorder = Recorder(options.record, server)
    return session, about


def _simulate(options: argparse.Namespace) -> int:
    """Test a model on a simulated arm in closed loop, or record data.

    The model plans actions towards goal images. Its success rate is compared with those of the zero action, random
    actions and an oracle. The exit status is 1 if the model returned no finite energy in any decision. `simulate record
    FOLDER` records demonstrations of the arm as a DROID data set instead.
    """
    if options.world is not None:
        _require_unset(options, ("task", "domain"), problem="--world, which defines task and scene itself")
    elif options.world_timeout is not None:
        raise InputError(where="--world-timeout", found="no --world", needed="--world COMMAND, whose answers it limits")
    if options.subject == "record":
        _require_unset(options, _MODEL_OPTIONS, problem="`simulate record`, which uses no model")
        return _record(options)
    _require_unset(options, _RECORD_OPTIONS, problem="a model, but the option is for `simulate record FOLDER`")
    return _run_benchmark(options)


def _record(options: argparse.Namespace) -> int:
    if len(options.overrides) != 1:
        problem = " ".join(options.overrides) or "no folder"
        raise InputError(where="simulate record", found=problem, needed="one folder for the data set")
    try:
        target = cli.as_path(options.overrides[0])
    except argparse.ArgumentTypeError as error:
        raise InputError(where="simulate record", found=str(error), needed="a local folder") from None
    if options.world is not None:
        return _record_world(options, target)
    cli.require_new_path(target)

    from vjepa2_ac.simulation.record import RecordingSpec, default_steps, record_dataset

    task = None if options.task == "reach" else options.task
    spec = cli.make_record(RecordingSpec, options, task=task, steps=options.steps or default_steps(task))
    episodes, workers = options.episodes or 40, options.workers or 1
    with cli.make_reporter() as reporter:
        progress = reporter.task("recording")
        progress(0, episodes)
        folder = record_dataset(target, spec, episodes=episodes, workers=workers, progress=progress)
    cli.show(f"{counted(episodes, 'episode')} in {folder}")
    return 0


def _record_world(options: argparse.Namespace, target: Path) -> int:
    _require_unset(options, _RECORD_OPTIONS, problem="--world, which uses one camera and one process")

    from vjepa2_ac.simulation.worlds import ExternalEnvironment, record_world

    with ExternalEnvironment(options.world, options.world_timeout) as world, cli.make_reporter() as reporter:
        seeds = range(options.seed or 0, (options.seed or 0) + (options.episodes or 40))
        solved, shown = record_world(world, target, seeds, reporter.task("recording"))
    content = f"the expert solved {solved} of {shown}, the remaining episodes are random exploration"
    cli.show(f"{counted(len(seeds), 'episode')} in {target}; {content}. Next: {shell_command('init', target)}")
    return 0


def _run_benchmark(options: argparse.Namespace) -> int:
    manifest = _read_manifest(options)
    _require_benchmark(options)

    from vjepa2_ac.cli.tables import benchmark_notes, benchmark_table
    from vjepa2_ac.evaluation.summary import closed_loop_verdict
    from vjepa2_ac.simulation.benchmark import write_benchmark

    benchmark, folder = _measure(options, manifest)
    verdict = closed_loop_verdict(
        {result.policy: result.success_rate for result in benchmark.results},
        model=benchmark.results[0].policy,
        oracle=benchmark.results[-1].policy,
        problems=len(benchmark.trials.trials),
        task=benchmark.trials.task,
        conditions=benchmark.conditions,
    )
    files = write_benchmark(benchmark, folder, asdict(verdict))
    if options.all:
        subject = benchmark.subject
        title = f"{subject.name}: checkpoint {subject.checkpoint_label}" if subject.checkpoint_label else subject.name
        cli.show(title, benchmark_table(benchmark), files=files)
    summary = _make_summary(benchmark, verdict, options)
    cli.show(*benchmark_notes(benchmark), str(summary), *_recommend_next(summary, verdict, options))
    cli.show(*(f"Video: {file}" for file in files[1:2]))
    return int(any(set(result.reason_counts) == {"no finite energy"} for result in benchmark.results))


def _require_benchmark(options: argparse.Namespace) -> None:
    """Check that the domain can be used for a model and that the run or model exists.

    Raises:
        InputError: The domain is for recording only, or the run or model does not exist.
    """
    if options.domain == "random":
        raise InputError(
            where="--domain random", found="a model", needed="A or B, because random is for `simulate record`"
        )
    cli.read_planning_config(options)


def _measure(
    options: argparse.Namespace, manifest: Manifest | WorldManifest | None
) -> tuple[ClosedLoopBenchmark, Path]:
    """Run the closed-loop benchmark; return its result and the folder for its files."""
    from vjepa2_ac.simulation.benchmark import BenchmarkOptions, require_measured_inputs, run_benchmark
    from vjepa2_ac.simulation.domains import load_mujoco
    from vjepa2_ac.simulation.manifest import Manifest, WorldManifest
    from vjepa2_ac.simulation.worlds import ExternalEnvironment

    request = cli.make_record(BenchmarkOptions, options)
    request = replace(request, films=min(request.films, request.episodes))
    if manifest is not None:
        request = manifest.options(request.films)
    name = f"{request.task}-{request.world.name}"
    with contextlib.ExitStack() as stack:
        if options.world is None:
            load_mujoco()
        else:
            env = stack.enter_context(ExternalEnvironment(options.world, options.world_timeout))
            if isinstance(manifest, WorldManifest):
                manifest.require_environment(env)
            name = re.sub(r"\W+", "-", f"{env.about.task} {env.about.world}", flags=re.ASCII).strip("-")[:200]
        subject, reporter = cli.load_planning_session(options), stack.enter_context(cli.make_reporter())
        require_measured_inputs(subject, world=options.world is not None)
        home = Path(options.subject) if is_run(options.subject) else Path()
        folder = options.out or home / "closed_loop" / name
        cli.make_folder(folder)
        if manifest is not None:
            manifest.require_stride(subject.config.data.model_stride)
            subject = replace(subject, config=subject.config.model_copy(update={"seed": manifest.planning_seed}))
        if options.world is not None:
            return _run_in_world(options, manifest, request, subject, env, reporter), folder
        if options.manifest is not None and manifest is None:
            _write_manifest(options.manifest, Manifest.of(request, subject))
        return run_benchmark(subject, request, reporter), folder


def _read_manifest(options: argparse.Namespace) -> Manifest | WorldManifest | None:
    """Return the manifest and add its settings to the overrides; None if `--manifest` is not set or names a new file.

    Raises:
        InputError: The file is not a manifest, or an option or override would change what the manifest determines.
    """
    if options.manifest is None or not options.manifest.exists():
        return None
    from vjepa2_ac.simulation.manifest import WorldManifest, read_manifest

    manifest = read_manifest(options.manifest)
    if isinstance(manifest, WorldManifest) != (options.world is not None):
        needs_world = options.world is None
        place = "a third-party environment" if needs_world else "the simulated arm"
        fix = "Start the environment with --world COMMAND" if needs_world else "Omit --world"
        raise InputError(where=f"--manifest {options.manifest}", found=f"problems in {place}", fix=fix)
    words = [f"--{name.replace('_', '-')}" for name in _MANIFEST_OPTIONS if getattr(options, name) is not None]
    keys = {f"planning.{key}" for key in manifest.planning}
    words += [word for word in options.overrides if ".".join(word.partition("=")[0].split(".")[:2]) in keys]
    if words:
        problem, fix = "a setting that the manifest determines", f"Leave out {words[0]}, or write a new manifest"
        raise InputError(where=f"{words[0]} with --manifest", found=problem, fix=fix)
    options.overrides = [*options.overrides, *manifest.overrides]
    return manifest


def _write_manifest(path: Path, manifest: Manifest | WorldManifest) -> None:
    manifest.write(path)
    cli.show(f"Manifest: {path}. To repeat this measurement, pass --manifest {path}")


def _run_in_world(
    options: argparse.Namespace,
    manifest: Manifest | WorldManifest | None,
    request: BenchmarkOptions,
    subject: Subject,
    world: ExternalEnvironment,
    reporter: Reporter,
) -> ClosedLoopBenchmark:
    """Run the benchmark in a third-party environment; write its manifest, or report differences from the manifest."""
    from vjepa2_ac.simulation.manifest import WorldManifest
    from vjepa2_ac.simulation.worlds import run_world_benchmark

    differences = list[str]()

    def handle_manifest(expert: ClosedLoopResult) -> None:
        if isinstance(manifest, WorldManifest):
            lines = (*manifest.describe_versions(world.about), *manifest.describe_starts(expert))
            differences.extend(f"Difference from the manifest: {line}" for line in lines)
            cli.show(*differences)
        elif options.manifest is not None:
            _write_manifest(options.manifest, WorldManifest.of(request, subject, world, expert))

    benchmark = run_world_benchmark(subject, world, request, reporter, handle_manifest)
    return replace(benchmark, subject=replace(subject, warnings=(*subject.warnings, *differences)))


def _make_summary(benchmark: ClosedLoopBenchmark, verdict: Verdict, options: argparse.Namespace) -> Summary:
    """Return a summary of the closed-loop verdict and, if `evaluate` measured this checkpoint, its other verdicts."""
    from vjepa2_ac.evaluation.summary import PREDICTION, RANKING, SENSITIVITY, Summary, not_measured_verdict
    from vjepa2_ac.reports.metrics_json import METRICS_FILE, read_metrics

    subject, trials = benchmark.subject, benchmark.trials
    command = _evaluate_command(options) or "`vjepa2-ac evaluate`"
    prediction, sensitivity, ranking = (
        not_measured_verdict(name, command) for name in (PREDICTION, SENSITIVITY, RANKING)
    )
    measured = f"{trials.task}, {trials.place}, {counted(trials.steps, 'step')} of {trials.seconds_per_step:.2f} s"
    summary = Summary(subject.name, measured, prediction, sensitivity, ranking, verdict)
    if subject.checkpoint_label and (Path(subject.name) / METRICS_FILE).is_file():
        with contextlib.suppress(InputError):  # metrics.json has an older format: keep "not measured"
            evaluated = read_metrics(Path(subject.name))
            # The text after the name differs between versions of metrics.json, so only the names are compared.
            names = {text.partition(" ")[0] for text in (evaluated.about.checkpoint, subject.checkpoint_label)}
            if len(names) == 1:
                summary = replace(evaluated.summary, measured=measured, planning=verdict)
    return summary


def _recommend_next(summary: Summary, verdict: Verdict, options: argparse.Namespace) -> list[str]:
    """Return a line with the recommended next command; empty if there is none."""
    is_evaluated, command = summary.prediction.value is not None, _evaluate_command(options)
    if verdict.needs or options.sub_goals is not None:  # the verdict states the fix; a server plans without sub-goals
        return []
    if verdict.conclusion == "yes" and (is_evaluated or not command):
        words = cli.make_option_words(options, "checkpoint", "config", "plugin")
        command = shell_command("serve", options.subject, *words, *options.overrides)
    elif command and is_evaluated:
        if any(map(sets_movable_path, options.overrides)):  # `data calibrate` needs the base model at its original path
            return []
        command = shell_command("data", "calibrate", f"{options.subject}/config.yaml", "--axes", options.subject)
    return [f"Next: {command}"] * bool(command)


def _evaluate_command(options: argparse.Namespace) -> str:
    """Return the `evaluate` command for the tested run; empty for a model, because its data are not known."""
    words = [*cli.make_option_words(options, "checkpoint", "plugin"), *filter(sets_movable_path, options.overrides)]
    return shell_command("evaluate", options.subject, *words) if is_run(options.subject) else ""


def _require_unset(options: argparse.Namespace, names: Sequence[str], *, problem: str) -> None:
    """Check that options without an effect in this mode are not set.

    Args:
        options: Parsed arguments.
        names: Names of the options that have no effect.
        problem: Why they have no effect, for the error.

    Raises:
        InputError: One of the options is set.
    """
    for name in names:
        if getattr(options, name) is not None:
            option = f"--{name.replace('_', '-')}"
            raise InputError(where=option, found=f"used with {problem}", fix=f"Omit {option}")
