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

_DEFAULT_ACTIONS = ("none", "up", "left", "close")  # of `imagine --image`, which has no recorded actions

if TYPE_CHECKING:
    from vjepa2_ac.decoding.imagine import RolloutComparison
    from vjepa2_ac.evaluation.imagined import ImagineOptions
    from vjepa2_ac.evaluation.result import About
    from vjepa2_ac.reports.write import WrittenEvaluation


def add_evaluate(commands: cli.Commands) -> None:
    """Add `evaluate` to a parser."""
    parser = cli.add_command(commands, "evaluate", _evaluate, "demo/run --clips 64 --decoder demo/decoder")
    cli.add(parser, "subject RUN_OR_MODEL", "a run, or (with --data) a value of model.base", cli.as_model)
    cli.add_overrides(parser, "model.base=PATH, if the base model was moved")
    cli.add(
        parser,
        "--against base|RUN|MODEL",
        "the models to compare with (the base model of a run)",
        cli.as_model,
        nargs="+",
    )
    cli.add(parser, "--clips N", "maximum number of clips, spread over the episodes (256)", cli.count)
    cli.add_decoder(parser, "the rollouts as images; their errors are measured")
    cli.add(parser, "--out FOLDER", "output folder (the run's folder)", cli.as_path)
    cli.add_all(parser)
    group = parser.add_argument_group("data")
    cli.add(group, "--data CONFIG", "a config, whose data, model.dtype, device and seed are used", cli.as_local)
    cli.add(group, "--split", "held-out episodes to measure (test)", choices=["test", "validation"])
    cli.add_checkpoint(group)
    group = parser.add_argument_group("sensitivity to actions")
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
    cli.add(group, "--at-once N", "actions in one batch (64); a smaller batch needs less memory", cli.count)


def add_compare(commands: cli.Commands) -> None:
    """Add `compare` to a parser."""
    parser = cli.add_command(commands, "compare", _compare, "runs/lora runs/full --out comparison.png")
    cli.add(parser, "runs RUN", "folders with a metrics.json, two or more", cli.as_path, nargs="+")
    cli.add(parser, "--out PNG", "the image (comparison.png)", cli.as_path, default=Path("comparison.png"))
    cli.add_all(parser)


def add_imagine(commands: cli.Commands) -> None:
    """Add `imagine` to a parser."""
    parser = cli.add_command(commands, "imagine", _imagine, "demo/run --decoder demo/decoder --actions true,up,left")
    cli.add_planner(parser, "such as model.base=PATH; with --image: planning.limits.xyz=data")
    cli.add_decoder(parser, "the predicted frames", required=True)
    text = "separated by commas: true (the recorded actions), none, up, down, left, right, forward, back, open, close,"
    text += " or .npy and .csv files with 7 numbers for each step (true,none,up,left,close)"
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
    cli.add(group, "--data CONFIG", "a config, whose data are used; required for a model", cli.as_local)
    group = parser.add_argument_group("instead of a clip")
    cli.add(group, "--image IMAGE", "a camera image (PNG or JPEG); `--actions true` needs a clip", cli.as_local)
    cli.add(group, "--state NUMBERS", "the measured state, as for `plan --state`", cli.as_numbers)


def _evaluate(options: argparse.Namespace) -> None:
    """Measure the errors of a run or model on held-out episodes.

    The predictions are compared with those of the base model, with persistence, and with predictions for wrong actions.
    """
    from vjepa2_ac.evaluation.request import ProbeOptions, resolve_config

    subject = options.subject
    if unused := [word for word in options.overrides if not sets_movable_path(word)]:
        needed = "one run or model, and model.base=PATH if its base model was moved"
        fix = "For a second run use --against RUN, or call evaluate again. Other config keys cannot be changed"
        raise InputError(where="command line", found=" ".join(unused), needed=needed, fix=fix)
    request = cli.make_evaluation_options(options, probes=cli.make_record(ProbeOptions, options))
    cli.require_subject(subject, resolve_config(subject, request), options.words)
    cli.report_remote_urls(subject)

    from vjepa2_ac.cli.tables import row_tables
    from vjepa2_ac.distributed import leave_processes
    from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
    from vjepa2_ac.evaluation.rows import make_rows
    from vjepa2_ac.reports.write import write_evaluation

    with cli.make_reporter() as reporter:
        evaluation = evaluate_subject(subject, request, reporter=reporter if is_first_process() else SILENT)
        if is_first_process():  # the other processes only take part in the computation
            reporter.task("writing report and figures")
            measured = write_evaluation(evaluation, request.out or Path(subject))
    if is_first_process():
        if options.all:
            checkpoint, notes = evaluation.about.checkpoint, evaluation.notes
            name = f"{subject}: checkpoint {checkpoint}" if checkpoint else subject
            tables = row_tables(make_rows(evaluation), "Held-out episodes")
            cli.show(name, *tables, *notes, files=measured.files)
        cli.show(str(measured.summary), *_recommend_next(measured, options))
        video = "" if evaluation.decoded is None else "video and "
        cli.show(f"Report with {video}all tables: {measured.report}")
    leave_processes()


def _recommend_next(measured: WrittenEvaluation, options: argparse.Namespace) -> list[str]:
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
        elif summary.planning is None and (simulate_words := _make_simulate_words(about, options)):
            words = simulate_words
        elif summary.verdicts[2].conclusion == "yes":  # `serve` is recommended only after a measured improvement
            words = ["serve", about.subject, *cli.make_option_words(options, "checkpoint"), *settings]
        else:
            return []
    return [f"Next: {shell_command(*words, *cli.make_option_words(options, 'plugin'))}"]


def _make_simulate_words(about: About, options: argparse.Namespace) -> list[str]:
    """Return the arguments of the command that tests a run in closed loop; empty unless its data were simulated."""
    from vjepa2_ac.simulation.domains import Domain
    from vjepa2_ac.simulation.record import read_simulation

    try:
        recorded = read_simulation(Path(about.data).resolve(strict=True))
    except (OSError, UserError):
        return []
    task, domain = recorded.task or "reach", recorded.worlds.name if isinstance(recorded.worlds, Domain) else "A"
    words = [
        "simulate",
        about.subject,
        "--task",
        task,
        "--domain",
        domain,
        *cli.make_option_words(options, "checkpoint"),
    ]
    return [*words, *options.overrides]


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

    The rollouts start from a frame of a held-out clip, or from an image. For a clip, the rollout with the recorded
    actions is shown with the true frames and the base model's rollout. Other actions can be named. For data from
    `simulate record`, the simulator also shows the true outcome of the other actions. The command writes an image
    strip, an MP4 and a GIF. Decoded frames are no evidence of success (docs/decoding.md).
    """
    from vjepa2_ac.evaluation.request import resolve_config

    _require_valid_start(options)
    home = Path(options.subject) if is_run(options.subject) else Path()
    out = options.out or home / "imagined"
    evaluation = cli.make_evaluation_options(options, out=out)
    if options.image is not None:
        cli.read_planning_config(options)
    else:
        cli.require_subject(options.subject, resolve_config(options.subject, evaluation), options.words)

    from vjepa2_ac.decoding.imagine import write_rollouts
    from vjepa2_ac.evaluation.imagined import ImagineOptions, require_actions

    actions = options.actions or (None if options.image is None else _DEFAULT_ACTIONS)
    values = {"evaluation": evaluation, "size_m": options.size / 100} | ({"actions": actions} if actions else {})
    request = cli.make_record(ImagineOptions, options, **values)
    require_actions(request, has_recorded=options.image is None)
    with cli.make_reporter() as reporter:
        imagine = _imagine_clip if options.image is None else _imagine_image
        rollouts = imagine(options, request, reporter)
        written = write_rollouts(rollouts, out, reporter=reporter)
    cli.show(*rollouts.notes, files=written)


def _require_valid_start(options: argparse.Namespace) -> None:
    """Check that the options select one start: a clip, or an image with its state.

    Raises:
        InputError: Options are missing or contradict each other.
    """
    if options.start is not None and options.episode is None:
        raise InputError(where="--start", found="no --episode", needed="--episode: --start is one of its control steps")
    if (options.image is None) != (options.state is None):
        raise InputError(where="--image, --state", found="only one of them", needed="both, recorded at the same time")
    clip = {"--episode": options.episode, "--data": options.data}
    if options.image is not None and (used := [name for name, value in clip.items() if value is not None]):
        raise InputError(where="--image", found=f"also {', '.join(used)}", needed="a clip or an image, not both")


def _imagine_clip(options: argparse.Namespace, request: ImagineOptions, reporter: Reporter) -> RolloutComparison:
    from vjepa2_ac.evaluation.imagined import imagine_clip
    from vjepa2_ac.simulation.counterfactual import simulated_outcome

    cli.report_remote_urls(options.subject)
    return imagine_clip(options.subject, request, simulate=simulated_outcome, reporter=reporter)


def _imagine_image(options: argparse.Namespace, request: ImagineOptions, _reporter: Reporter) -> RolloutComparison:
    from vjepa2_ac.evaluation.imagined import ImageObservation, imagine_image
    from vjepa2_ac.media.images import read_image

    observation = ImageObservation(read_image(options.image), options.state, options.extrinsics)
    return imagine_image(cli.load_planning_session(options), request, observation)


def _names(text: str) -> tuple[str, ...]:
    """Parse the value of --actions: names or files, separated by commas."""
    if names := tuple(word for word in text.split(",") if word):
        return names
    raise argparse.ArgumentTypeError("no actions; give one or more names, separated by commas")
