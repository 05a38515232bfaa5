"""The evaluate and compare commands: metrics of runs and models on held-out episodes."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac.cli.options import (
    Commands,
    SubjectsAndOverrides,
    as_local,
    as_model,
    as_path,
    as_subject,
    command,
    count,
    number_between,
    read_config,
    require_overrides,
    require_subject,
    say_places_elsewhere,
    whole_number,
)
from vjepa2_ac.errors import InputError

if TYPE_CHECKING:
    from vjepa2_ac.evaluation.request import EvaluationOptions


def add_evaluate(commands: Commands[argparse.ArgumentParser]) -> None:
    """Add `evaluate` and `compare` to a parser."""
    _add_evaluate(commands)
    _add_compare(commands)


def add_checkpoint(parser: argparse._ActionsContainer) -> None:
    """Add the option that selects a checkpoint of a run."""
    parser.add_argument(
        "--checkpoint",
        default="newest",
        metavar="newest|best|STEP",
        help="which one: the newest (default), the best by validation, or that of a step",
    )


def _add_evaluate(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = command(
        commands,
        "evaluate",
        _evaluate,
        "Measure a run or a model on held-out episodes, beside its base, doing nothing and wrong actions.",
    )
    parser.add_argument(
        "subjects",
        metavar="RUN_OR_MODEL",
        type=as_subject,
        nargs="+",
        action=SubjectsAndOverrides,
        help="folder of a run, or (with --data) what model.base takes; several: their spread, too",
    )
    parser.add_argument(
        "--data",
        metavar="CONFIG",
        type=as_local,
        help="measure on the data of this config (and with its model.dtype, device, seed)",
    )
    parser.add_argument(
        "--against",
        metavar="base|RUN|MODEL",
        type=as_model,
        nargs="+",
        help="what to compare with, on the same latents; default: the base of a run, nothing for a model",
    )
    parser.add_argument("--out", metavar="FOLDER", type=as_path, help="where figures go; default: the run's folder")
    parser.add_argument("--split", choices=["test", "validation"], default="test", help="which held-out episodes")
    parser.add_argument("--clips", type=count, default=256, help="at most this many clips, spread over the episodes")
    add_checkpoint(parser)
    parser.add_argument("--calibrate", action="store_true", help="measure the one-step error at other strides, too")
    parser.set_defaults(overrides=[])
    _add_probes(parser)
    _add_planning(parser)


def _add_probes(parser: argparse.ArgumentParser) -> None:
    probes = parser.add_argument_group("use of the actions")
    probes.add_argument(
        "--sensitivity-clips", metavar="N", type=whole_number(0), default=32, help="clips to try other actions on (32)"
    )
    probes.add_argument("--samples", metavar="N", type=count, default=64, help="other actions for each of them (64)")
    probes.add_argument(
        "--landscapes",
        metavar="N",
        type=whole_number(0),
        default=8,
        help="clips of those with an energy landscape (8)",
    )
    probes.add_argument(
        "--axes", metavar="N", type=whole_number(0), default=32, help="clips of those to calibrate the axes by (32)"
    )
    probes.add_argument(
        "--nodes", metavar="N", type=whole_number(3, 51), default=9, help="of a landscape along each axis (9)"
    )
    probes.add_argument(
        "--reach",
        metavar="CM",
        type=number_between(0.0, 1000.0, "cm"),
        default=7.5,
        help="half the width of landscape and box, in cm (7.5)",
    )
    probes.add_argument("--examples", metavar="N", type=whole_number(0), default=4, help="clips to show (4)")
    probes.add_argument(
        "--at-once", metavar="N", type=count, default=64, help="actions computed together (64): lower it to save memory"
    )


def _add_planning(parser: argparse.ArgumentParser) -> None:
    planning = parser.add_argument_group("plans (they take long: see docs/evaluation.md)")
    planning.add_argument(
        "--planning",
        metavar="planning.key=value",
        nargs="*",
        help="plan from held-out frames, and hold the plans against the demonstrations: action error, Action Score;"
        " settings of the plan of one step, such as planning.samples=200, in place of the config's, here or anywhere",
    )
    planning.add_argument(
        "--planning-clips", metavar="N", type=count, default=32, help="clips to plan from, one frame of each (32)"
    )


def _evaluate(options: argparse.Namespace) -> None:
    from vjepa2_ac.evaluation.request import settle

    asked = _asked(options)
    for subject, how in asked:  # wrong words are told before what takes seconds is imported
        settle(subject, how)
        require_subject(subject, how.checkpoint)

    from vjepa2_ac.console.evaluation import evaluation_tables
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.evaluation.verdict import spread, verdict
    from vjepa2_ac.reports.write import evaluate_subject

    evaluations = []
    for subject, how in asked:
        say_places_elsewhere(subject)
        with ConsoleReporter() as reporter:
            measured = evaluate_subject(subject, how, reporter)
        evaluations.append(measured.evaluation)
        console.print(f"{subject}: checkpoint {measured.checkpoint}" if measured.checkpoint else subject)
        for table in evaluation_tables(measured.evaluation):
            console.print(table)
        console.print(verdict(measured.evaluation))
        for path in measured.files:
            console.print(f"  {path}")
    if len(evaluations) > 1:
        console.print(spread(evaluations))


def _asked(options: argparse.Namespace) -> list[tuple[str, EvaluationOptions]]:
    """Return what is asked of each subject."""
    from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions

    _require_planning(options)
    probes = ProbeOptions(
        sensitivity_clips=options.sensitivity_clips,
        samples=options.samples,
        landscape_clips=options.landscapes,
        axis_clips=options.axes,
        nodes=options.nodes,
        reach_cm=options.reach,
        examples=options.examples,
        at_once=options.at_once,
        planning_clips=0 if options.planning is None else options.planning_clips,
    )
    several = len(options.subjects) > 1
    every = EvaluationOptions(
        split=options.split,
        clips=options.clips,
        checkpoint=options.checkpoint,
        data=read_config(options.data) if options.data else None,
        against=tuple(options.against) if options.against else None,
        probes=probes,
        calibrate=options.calibrate,
        planning=(*(options.planning or ()), *options.overrides),
    )
    return [
        (subject, replace(every, out=options.out / Path(subject).name if options.out and several else options.out))
        for subject in options.subjects
    ]


def _require_planning(options: argparse.Namespace) -> None:
    """Refuse planning settings if no plans are requested: they would have no effect."""
    require_overrides(options.overrides, fix="Name all runs and models one behind the other, before the options")
    if options.overrides and options.planning is None:
        raise InputError(
            where="command line",
            found=f"{' '.join(options.overrides)}, and no plans are asked for",
            needed="--planning beside settings of planning; what else a config says is not changed by evaluate",
            fix="Add --planning",
        )


def _add_compare(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = command(
        commands,
        "compare",
        _compare,
        "Put runs side by side that `evaluate` has measured on the same clips: one table, one image.",
    )
    parser.add_argument("runs", metavar="RUN", type=as_path, nargs="+", help="folders with a metrics.json, two or more")
    parser.add_argument("--out", metavar="PNG", type=as_path, default=Path("comparison.png"), help="the image")


def _compare(options: argparse.Namespace) -> None:
    from vjepa2_ac.reports.comparison import compare

    comparison = compare(options.runs)

    from vjepa2_ac.console.evaluation import comparison_table
    from vjepa2_ac.console.progress import console
    from vjepa2_ac.reports.figures.evaluation import plot_comparison

    console.print(comparison_table(comparison))
    for line in comparison.notes:
        console.print(line)
    console.print(f"  {plot_comparison(comparison, options.out)}")
