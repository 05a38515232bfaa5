"""The commands score (rank policies), prior (train an action prior) and monitor (detect anomalies)."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from vjepa2_ac.cli import options as cli
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.runs.folder import CONFIG, is_run

_FORMS = ("targets", "deltas", "offsets")


def add_score(commands: cli.Commands) -> None:
    """Add `score` to a parser."""
    parser = cli.add_command(commands, "score", _score, "demo/run --policy mine.npz --policy other.npz")
    cli.add_planner(parser, "such as planning.energy.distance=l2")
    text = "actions of a policy at recorded frames (.npz); repeat the option for several policies"
    cli.add(parser, "--policy FILE", text, cli.as_path, action="append", dest="policies", required=True)
    text = (
        "targets: poses to reach; deltas: changes from pose to pose; offsets: changes from the current pose (targets)"
    )
    cli.add(parser, "--form FORM", text, choices=_FORMS, default="targets")
    cli.add(parser, "--control-steps N", "steps of a chunk in one model step (data.stride)", cli.count)
    cli.add(parser, "--out FILE", "output file (score.json)", cli.as_path, default=Path("score.json"))


def add_prior(commands: cli.Commands) -> None:
    """Add `prior` to a parser."""
    parser = cli.add_command(commands, "prior", _prior, "demo/run")
    cli.add(parser, "subject RUN|CONFIG", "a run or a config, whose data and encoder are used", cli.as_local)
    cli.add_overrides(parser, "config keys to change, such as training.device=cpu")
    cli.add(parser, "--out FOLDER", "output folder (prior in the run's folder)", cli.as_path)
    cli.add(parser, "--steps N", "optimizer steps (2000)", cli.count)
    cli.add(parser, "--learning-rate X", "peak learning rate (0.001)", cli.number_between(0, 1))
    text = "a prior for the same encoder; training starts from its weights (random weights)"
    cli.add(parser, "--pretrained FOLDER", text, cli.as_path)
    cli.add(
        parser, "--ahead N", "maximum number of model steps from a frame to its goal (the length of a clip)", cli.count
    )


def add_monitor(commands: cli.Commands) -> None:
    """Add `monitor` to a parser."""
    parser = cli.add_command(commands, "monitor", _monitor, "demo/run --episode 3")
    cli.add_planner(parser, "such as model.dtype=bfloat16")
    cli.add(parser, "--data CONFIG", "a config, whose data are checked (the run's data)", cli.as_local)
    cli.add(parser, "--episode ID|NUMBER", "an episode to check; repeatable", action="append", default=[])
    fraction = cli.number_between(0.0, 1.0)
    cli.add(
        parser,
        "--false-alarms SHARE",
        "maximum fraction of undisturbed episodes with an alarm (0.05)",
        fraction,
        default=0.05,
    )
    cli.add(
        parser,
        "--threshold FILE",
        "a monitor.json with the threshold (a new one, calibrated on the held-out episodes)",
        cli.as_local,
    )
    cli.add(parser, "--out FOLDER", "output folder (the run's folder)", cli.as_path)


def _score(options: argparse.Namespace) -> int:
    """Rank policies by the energy of their actions at held-out frames.

    An action chunk is better than another if the model predicts an outcome closer to the goal. The exit status is 1 if
    the model ranks true actions no better than chance.
    """
    cli.read_planning_config(options)

    from vjepa2_ac.cli.tables import scores_table
    from vjepa2_ac.data.windows import require_frames
    from vjepa2_ac.planning.controller import Controller
    from vjepa2_ac.policies.score import CHANCE, read_policy_chunks, score_policies

    policies = [read_policy_chunks(file) for file in options.policies]
    session = cli.load_planning_session(options)
    require_frames(session.config.data, to="score policies at")
    with cli.make_reporter() as reporter:
        scores = score_policies(
            Controller.of_subject(session, extrinsics=options.extrinsics),
            cli.open_data(session.config, reporter),
            policies,
            form=options.form,
            control_steps=options.control_steps,
            progress=reporter.task("scoring", "frames"),
        )
    share = f"{scores.others_below_true:.0%} of the actions from other frames"
    notes = [f"{share} have a lower energy than the true actions (chance {CHANCE:.0%})."]
    if scores.is_blind:
        notes.append("Not ranked: the model ranks the true actions no better than chance on these data.")
    if scores.left_out:
        notes.append(f"Left out: {counted(scores.left_out, 'frame')} whose episode ends before the goal.")
    about = session.as_dict() | {"policies": [str(file) for file in options.policies], "form": options.form}
    cli.show(scores_table(scores), *notes, files=[cli.write_json(options.out, about | scores.as_dict())])
    return int(scores.is_blind)


def _monitor(options: argparse.Namespace) -> int:
    """Detect frames that deviate from the model's predictions.

    Each frame of an episode is predicted from the previous one. The threshold is calibrated on held-out episodes
    without disturbances. With `planning.monitor=FILE`, `serve` reports alarms.
    The exit status is 1 if a checked episode has an alarm.
    """
    if (views := cli.read_planning_config(options).planning.views) > 1:
        needed, fix = "1, because a monitor uses one camera", "Add planning.views=1"
        raise InputError(where="planning.views", found=f"{views}", needed=needed, fix=fix)
    if options.out is None and not is_run(options.subject):
        problem, needed = "a model, which has no folder for the monitor", "the folder of a run, or a model with --out"
        raise InputError(
            where=str(options.subject), found=problem, needed=needed, fix="Add --out FOLDER and --data CONFIG"
        )
    data = None if options.data is None else cli.read_config(options.data)
    folder = Path(options.out or options.subject)
    cli.make_folder(folder)

    from dataclasses import asdict

    from vjepa2_ac.cli.tables import surprise_table
    from vjepa2_ac.data.dataset import find_episode
    from vjepa2_ac.policies.monitor import MONITOR, Monitor, calibrate_monitor, measure_episodes

    session = cli.load_planning_session(options)
    model, files = session.world_model, []
    with cli.make_reporter() as reporter:
        dataset = cli.open_data(session.config, reporter)
        checked_data = dataset if data is None else cli.open_data(data, reporter)
        episodes = [find_episode(checked_data, name) for name in options.episode]
        if options.threshold is None:
            progress = reporter.task("held-out episodes", "episodes")
            monitor = calibrate_monitor(model, dataset, options.false_alarms, progress)
            files.append(cli.write_json(folder / MONITOR, asdict(monitor)))
        else:
            monitor = Monitor.read(
                options.threshold, model.fingerprints(), tokens=model.num_tokens, where="--threshold"
            )
        measured = list(measure_episodes(model, checked_data, episodes, reporter.task("checking", "episodes")))
    source = f"{counted(len(monitor.scores), 'held-out episode')} of up to {counted(monitor.steps, 'model step')}"
    note = f"An alarm is a surprise above {monitor.threshold:.4g}, calibrated on {source}. At most"
    note += f" {monitor.false_alarms:.1%} of undisturbed episodes have an alarm."
    cli.show(*([surprise_table(measured, monitor)] if measured else []), note, files=files)
    return int(any(episode.find_first_alarm(monitor) is not None for episode in measured))


def _prior(options: argparse.Namespace) -> None:
    """Train an action prior, which proposes actions to the planner.

    The prior learns from demonstrations which action leads from one image to another. With planning.prior=FOLDER
    searches start from its proposals and need fewer samples; with planning.planner=prior they need none. Training takes
    minutes.
    """
    run = is_run(options.subject)
    file = Path(options.subject) / CONFIG if run else options.subject
    config = cli.read_config(file, options.overrides, base=True, of_run=run)

    from vjepa2_ac.policies.action_prior import PriorOptions, train_prior

    folder = options.out or Path(options.subject if run else config.run_dir) / "prior"
    with cli.make_reporter() as reporter:
        card = train_prior(config, folder, cli.make_record(PriorOptions, options), reporter)
    text = "Error on held-out clips: not measured; it needs a test split."
    if errors := card.held_out:
        true, shuffled = (errors[name]["value"] for name in ("true_goals", "goals_of_others"))
        text = f"Error on held-out clips relative to the zero action: {true:.2f};"
        text += f" with goals of other clips {shuffled:.2f}."
        text += " The prior ignores the goal." if shuffled <= true else ""
    cli.show(text)
    cli.show(f"The prior is in {folder}. Plan with it: {shlex.quote(f'planning.prior={folder}')} planning.samples=100")
