"""The commands evaluate, compare and imagine, which measure and show predictions on held-out episodes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac.cli import options as cli
from vjepa2_ac.config.model import RANDOM
from vjepa2_ac.errors import InputError, UserError, shell_command
from vjepa2_ac.process import is_first_process
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.runs.folder import is_run, sets_movable_path

_NAMED = ("none", "up", "left", "close")  # default actions of `imagine --image`, which has no recorded actions

if TYPE_CHECKING:
    from vjepa2_ac.decoding.imagine import RolloutComparison
    from vjepa2_ac.evaluation.result import About
    from vjepa2_ac.reports.write import WrittenEvaluation


def add_evaluate(commands: cli.Commands) -> None:
    """Add `evaluate` to a parser."""
    parser = cli.command(commands, "evaluate", _evaluate, "demo/run --clips 64 --decoder demo/decoder")
    cli.add(parser, "subject RUN_OR_MODEL", "a run, or (with --data) a value of model.base", cli.as_model)
    cli.add(parser, "overrides key=value", "model.base=PATH, if the base model was moved", nargs="*")
    cli.add(
        parser,
        "--against base|RUN|MODEL",
        "the models to compare with (the base model of a run)",
        cli.as_model,
        nargs="+",
    )
    cli.add(parser, "--clips N", "at most this many clips, spread over the episodes (256)", cli.count)
    cli.add_decoder(parser, "the rollouts as images, and measure these, too")
    cli.add(parser, "--out FOLDER", "output folder (the run's folder)", cli.as_path)
    cli.add_all(parser)
    group = parser.add_argument_group("data, and what is measured")
    cli.add(group, "--data CONFIG", "a config: use its data, model.dtype, device and seed", cli.as_local)
    cli.add(group, "--split", "held-out episodes to measure (test)", choices=["test", "validation"])
    cli.add_checkpoint(group)
    group = parser.add_argument_group("use of the actions")
    cli.add(group, "--ranking-clips N", "clips for the action-ranking error (32)", cli.whole_number(0))
    cli.add(group, "--samples N", "alternative actions for each clip (64)", cli.count)
    cli.add(group, "--landscapes N", "clips with an energy landscape (8)", cli.whole_number(0), dest="landscape_clips")
    cli.add(group, "--nodes N", "points of a landscape along each axis (9)", cli.whole_number(3, 51))
    cli.add(
        group,
        "--reach CM",
        "half of the landscape's width (7.5)",
        cli.number_between(0.0, 1000.0, "cm"),
        dest="reach_cm",
    )
    cli.add(group, "--examples N", "example clips in the report (4)", cli.whole_number(0))
    cli.add(group, "--at-once N", "actions computed together (64): lower it to save memory", cli.count)


def add_compare(commands: cli.Commands) -> None:
    """Add `compare` to a parser."""
    parser = cli.command(commands, "compare", _compare, "runs/lora runs/full --out comparison.png")
    cli.add(parser, "runs RUN", "folders with a metrics.json, two or more", cli.as_path, nargs="+")
    cli.add(parser, "--out PNG", "the image (comparison.png)", cli.as_path, default=Path("comparison.png"))
    cli.add_all(parser)


def add_imagine(commands: cli.Commands) -> None:
    """Add `imagine` to a parser."""
    parser = cli.command(commands, "imagine", _imagine, "demo/run --decoder demo/decoder --actions true,up,left")
    cli.add_planner(parser, such_as="such as model.base=PATH; with --image: planning.limits.xyz=data")
    cli.add_decoder(parser, "the predicted frames", required=True)
    text = "true (as recorded), none, up, down, left, right, forward, back, open, close, with commas between them; or"
    text += " files, .npy or .csv, with a row of 7 numbers for each step (true,none,up,left,close)"
    cli.add(parser, "--actions NAMES", text, _names)
    cli.add(parser, "--steps N", "number of model steps (7)", cli.count, default=7)
    cli.add(
        parser, "--size CM", "length of a named action in each step, within planning.limits (5)", float, default=5.0
    )
    cli.add(parser, "--out FOLDER", "output folder (imagined in the run's folder)", cli.as_path)
    group = parser.add_argument_group("the clip")
    cli.add(group, "--episode ID", "name of the episode, or a part of it (the episode with the most motion)")
    cli.add(group, "--start N", "first control step of the clip (0)", cli.whole_number(0))
    cli.add(group, "--split", "episodes to use (test)", choices=["test", "validation", "train"], default="test")
    cli.add(group, "--data CONFIG", "a config: use its data; required for a model", cli.as_local)
    group = parser.add_argument_group("instead of a clip")
    cli.add(group, "--image IMAGE", "a camera image: PNG or JPEG; then actions are names only", cli.as_local)
    cli.add(group, "--state NUMBERS", "the measured state, as for `plan --state`", cli.as_numbers)


def _evaluate(options: argparse.Namespace) -> None:
    """Measure a run or a model on held-out episodes: is it better?

    The predictions are compared with those of the base model, with persistence, and with predictions for wrong actions.
    """
    from vjepa2_ac.evaluation.request import ProbeOptions, resolve_config

    subject = options.subject
    if unused := [word for word in options.overrides if not sets_movable_path(word)]:
        needed = "one run or model, and model.base=PATH if its base model was moved"
        fix = "For a second run use --against RUN, or call evaluate again. Other config keys cannot be changed"
        raise InputError(where="command line", found=" ".join(unused), needed=needed, fix=fix)
    request = cli.evaluation_options(options, probes=cli.record_of_options(ProbeOptions, options))
    cli.require_subject(subject, resolve_config(subject, request), options.words)
    cli.report_relocated_paths(subject)

    from vjepa2_ac.cli.tables import row_tables
    from vjepa2_ac.distributed import leave_processes
    from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
    from vjepa2_ac.evaluation.rows import make_rows
    from vjepa2_ac.reports.write import write_evaluation

    with cli.reporter() as reporter:
        evaluation = evaluate_subject(subject, request, reporter=reporter if is_first_process() else SILENT)
        if is_first_process():  # the other processes only share the computation
            reporter.task("writing report and figures")
            measured = write_evaluation(evaluation, request.out or Path(subject))
    if is_first_process():
        if options.all:
            checkpoint, notes = evaluation.about.checkpoint, evaluation.notes
            name = f"{subject}: checkpoint {checkpoint}" if checkpoint else subject
            tables = row_tables(make_rows(evaluation), "Held-out episodes")
            cli.show(name, *tables, *notes, files=measured.files)
        cli.show(str(measured.summary), *_next(measured, options))
        video = "" if evaluation.decoded is None else "video and "
        cli.show(f"Report with {video}all tables: {measured.report}")
    leave_processes()


def _next(measured: WrittenEvaluation, options: argparse.Namespace) -> list[str]:
    """Return a line with the recommended next command; empty if there is none."""
    about, summary, settings = measured.evaluation.about, measured.summary, options.overrides
    config = options.data or f"{about.subject}/config.yaml"
    words = ["data", "check", config]
    if not about.checkpoint:
        is_other = cli.read_config(config).model.base not in {RANDOM, about.subject}
        words = ["train", config, *[f"model.base={about.subject}"] * is_other]
    elif not summary.prediction.needs:
        if about.is_base or "no" in {verdict.conclusion for verdict in summary.verdicts[:3]}:
            words += ["--model", about.subject] * (not any(map(sets_movable_path, settings)))
        elif summary.planning is None and (simulation := _simulation(about, options)):
            words = simulation
        elif summary.verdicts[2].conclusion == "yes":  # `serve` is recommended only after a measured improvement
            words = ["serve", about.subject, *cli.option_words(options, "checkpoint"), *settings]
        else:
            return []
    return [f"Next: {shell_command(*words, *cli.option_words(options, 'plugin'))}"]


def _simulation(about: About, options: argparse.Namespace) -> list[str]:
    """Return the arguments of the command that tests a run in closed loop; empty unless its data were simulated."""
    from vjepa2_ac.distributed import is_on_cpu
    from vjepa2_ac.planning.settings import load_planning_config
    from vjepa2_ac.simulation.domains import Domain
    from vjepa2_ac.simulation.record import read_simulation

    try:
        recorded = read_simulation(Path(about.data).resolve(strict=True))
    except (OSError, UserError):
        return []
    task, domain = recorded.task or "reach", recorded.worlds.name if isinstance(recorded.worlds, Domain) else "A"
    config = load_planning_config(about.subject, overrides=options.overrides)
    quick = cli.quick_words(options.overrides, config.planning, on_cpu=is_on_cpu(config.training))
    words = ["simulate", about.subject, "--task", task, "--domain", domain, *cli.option_words(options, "checkpoint")]
    return [*words, *options.overrides, *quick]


def _compare(options: argparse.Namespace) -> None:
    """Compare evaluated runs in one table and one image.

    `evaluate` must have measured all runs on the same clips.
    """
    from vjepa2_ac.reports.comparison import compare

    comparison = compare(options.runs)

    from vjepa2_ac.cli.tables import row_tables
    from vjepa2_ac.reports.evaluation_figures import plot_comparison
    from vjepa2_ac.reports.metrics_json import write_csv

    tables = row_tables(comparison.rows, comparison.title) if options.all else []
    table = write_csv(comparison.rows, options.out.with_suffix(".csv"))
    files = [plot_comparison(comparison, options.out), table]
    cli.show(*tables, str(comparison), *comparison.notes, comparison.next_command, files=files)


def _imagine(options: argparse.Namespace) -> None:
    """Make a video of a model's predicted frames, for any actions.

    The rollouts start from a frame of a held-out clip, or from an image. For a clip, those with the recorded actions
    are shown with the true frames and those of the base model. Other actions can be named. For data from `simulate
    record`, the simulator also shows the true outcome of the other actions. The command writes an image strip, an MP4
    and a GIF. Decoded frames are no evidence of success (docs/decoding.md).
    """
    _require_one_start(options)

    from vjepa2_ac.decoding.imagine import write_rollouts

    home = Path(options.subject) if is_run(options.subject) else Path()
    out = options.out or home / "imagined"
    with cli.reporter() as reporter:
        imagination = _of_image(options) if options.image is not None else _of_clip(options, out, reporter)
        written = write_rollouts(imagination, out, reporter=reporter)
    cli.show(*imagination.notes, files=written)


def _require_one_start(options: argparse.Namespace) -> None:
    """Check that the options name one start: a clip, or an image with its state.

    Raises:
        InputError: Options are missing or contradict each other.
    """
    if options.start is not None and options.episode is None:
        raise InputError(where="--start", found="no --episode", needed="the episode whose control step it is")
    if (options.image is None) != (options.state is None):
        raise InputError(where="--image, --state", found="one of them", needed="both: state and image of one moment")
    clip = {"--episode": options.episode, "--data": options.data}
    if options.image is not None and (used := [name for name, value in clip.items() if value is not None]):
        raise InputError(where="--image", found=f"{', '.join(used)}, too", needed="a clip or an image, not both")


def _of_clip(options: argparse.Namespace, out: Path, reporter: Reporter) -> RolloutComparison:
    from vjepa2_ac.evaluation.imagined import ImagineOptions, imagine_clip
    from vjepa2_ac.evaluation.request import resolve_config
    from vjepa2_ac.simulation.counterfactual import simulated_outcome

    cli.report_relocated_paths(options.subject)
    how = {"evaluation": cli.evaluation_options(options, out=out), "size_m": options.size / 100}
    request = cli.record_of_options(ImagineOptions, options, **how)
    cli.require_subject(options.subject, resolve_config(options.subject, request.evaluation), options.words)
    return imagine_clip(options.subject, request, simulate=simulated_outcome, reporter=reporter)


def _of_image(options: argparse.Namespace) -> RolloutComparison:
    from vjepa2_ac.evaluation.imagined import ImageObservation, ImagineOptions, imagine_image
    from vjepa2_ac.media.images import read_image

    cli.require_to_plan(options)
    observation = ImageObservation(read_image(options.image), options.state, options.extrinsics)
    named = {"actions": options.actions or _NAMED, "size_m": options.size / 100}
    request = cli.record_of_options(ImagineOptions, options, **named)
    return imagine_image(cli.load_planning_session(options), request, observation)


def _names(text: str) -> tuple[str, ...]:
    """Parse the value of --actions: names or files with commas between them."""
    if names := tuple(word for word in text.split(",") if word):
        return names
    raise argparse.ArgumentTypeError("no actions; give one or more names, with commas between them")
