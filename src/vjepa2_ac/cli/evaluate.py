"""The evaluate and compare commands: metrics of runs and models on held-out episodes."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac.cli.options import (
    Commands,
    add_checkpoint,
    argument,
    as_local,
    as_model,
    as_path,
    as_subject,
    command,
    count,
    number_between,
    read_config,
    record_of_options,
    require_overrides,
    require_subject,
    say_places_elsewhere,
    whole_number,
)
from vjepa2_ac.errors import InputError

if TYPE_CHECKING:
    from vjepa2_ac.evaluation.request import EvaluationOptions


def add_to(commands: Commands) -> None:
    """Add `evaluate` and `compare` to a parser."""
    text = "Measure a run or a model on held-out episodes, beside its base, doing nothing and wrong actions."
    parser = command(commands, "evaluate", _evaluate, text)
    text = "folder of a run, or (with --data) what model.base takes; several: their spread, too"
    argument(parser, "subjects RUN_OR_MODEL", text, as_subject, nargs="+")
    text = "measure on the data of this config (and with its model.dtype, device, seed)"
    argument(parser, "--data CONFIG", text, as_local)
    text = "what to compare with, on the same latents; default: the base of a run, nothing for a model"
    argument(parser, "--against base|RUN|MODEL", text, as_model, nargs="+")
    argument(parser, "--out FOLDER", "where figures go; default: the run's folder", as_path)
    argument(parser, "--split", "which held-out episodes (test)", choices=["test", "validation"])
    argument(parser, "--clips N", "at most this many clips, spread over the episodes (256)", count)
    add_checkpoint(parser)
    text = "decode the rollouts and measure the images, too: what `vjepa2-ac decoder` made, or builtin:sim-tiny"
    argument(parser, "--decoder FOLDER", text, as_model)
    _add_metric_files(parser.add_argument_group("LPIPS of decoded images (see docs/decoding.md)"))
    argument(parser, "--calibrate", "measure the one-step error at other strides, too", action="store_true")
    _add_probes(parser.add_argument_group("use of the actions"))
    _add_planning(parser.add_argument_group("plans (they take long: see docs/evaluation.md)"))
    parser.set_defaults(overrides=[])

    text = "Put runs side by side that `evaluate` has measured on the same clips: one table, one image."
    parser = command(commands, "compare", _compare, text)
    argument(parser, "runs RUN", "folders with a metrics.json, two or more", as_path, nargs="+")
    argument(parser, "--out PNG", "the image (comparison.png)", as_path, default=Path("comparison.png"))


def _add_metric_files(group: argparse._ArgumentGroup) -> None:
    text = "LPIPS of the decoded images, by these weights: alexnet-owt-7be5be79.pth or vgg16-397923af.pth"
    argument(group, "--lpips FILE", text, as_path)
    argument(group, "--lpips-heads FILE", "its heads: alex.pth or vgg.pth of version 0.1", as_path)


def _add_probes(group: argparse._ArgumentGroup) -> None:
    argument(group, "--sensitivity-clips N", "clips to try other actions on (32)", whole_number(0))
    argument(group, "--samples N", "other actions for each of them (64)", count)
    text = "clips of those with an energy landscape (8)"
    argument(group, "--landscapes N", text, whole_number(0), dest="landscape_clips")
    text = "clips of those to calibrate the axes by (32)"
    argument(group, "--axes N", text, whole_number(0), dest="axis_clips")
    argument(group, "--nodes N", "of a landscape along each axis (9)", whole_number(3, 51))
    text = "half the width of landscape and box, in cm (7.5)"
    argument(group, "--reach CM", text, number_between(0.0, 1000.0, "cm"), dest="reach_cm")
    argument(group, "--examples N", "clips to show (4)", whole_number(0))
    argument(group, "--at-once N", "actions computed together (64): lower it to save memory", count)


def _add_planning(group: argparse._ArgumentGroup) -> None:
    text = (
        "plan from held-out frames, and hold the plans against the demonstrations: action error, Action Score; settings"
        " of the plan of one step, such as planning.samples=200, in place of the config's, here or anywhere"
    )
    argument(group, "--planning planning.key=value", text, nargs="*", dest="plan_settings")
    argument(group, "--planning-clips N", "clips to plan from, one frame of each (32)", count, default=32)


def _evaluate(options: argparse.Namespace) -> None:
    from vjepa2_ac.evaluation.request import settle

    asked = _asked(options)
    for subject, how in asked:  # wrong words are told before what takes seconds is imported
        settle(subject, how)
        require_subject(subject, how.checkpoint)

    from vjepa2_ac.console.evaluation import row_tables
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.evaluation.rows import rows_of
    from vjepa2_ac.evaluation.verdict import spread, verdict
    from vjepa2_ac.reports.write import evaluate_subject

    evaluations = []
    for subject, how in asked:
        say_places_elsewhere(subject)
        with ConsoleReporter() as reporter:
            measured = evaluate_subject(subject, how, reporter)
        evaluations.append(measured.evaluation)
        console.print(f"{subject}: checkpoint {measured.checkpoint}" if measured.checkpoint else subject)
        for table in row_tables(rows_of(measured.evaluation), "Held-out episodes"):
            console.print(table)
        console.print(verdict(measured.evaluation))
        for path in measured.files:
            console.print(f"  {path}")
    if len(evaluations) > 1:
        console.print(spread(evaluations))


def _asked(options: argparse.Namespace) -> list[tuple[str, EvaluationOptions]]:
    """Return what is asked of each subject; refuse planning settings that would have no effect: without plans."""
    from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions

    require_overrides(options.overrides, fix="Name all runs and models one behind the other, before the options")
    if options.overrides and options.plan_settings is None:
        found = f"{' '.join(options.overrides)}, and no plans are asked for"
        needed = "--planning beside settings of planning; what else a config says is not changed by evaluate"
        raise InputError(where="command line", found=found, needed=needed, fix="Add --planning")
    several, plan_settings = len(options.subjects) > 1, options.plan_settings
    clips = 0 if plan_settings is None else options.planning_clips
    every = record_of_options(
        EvaluationOptions,
        options,
        data=read_config(options.data, of_run=True) if options.data else None,
        against=tuple(options.against) if options.against else None,
        probes=record_of_options(ProbeOptions, options, planning_clips=clips),
        planning=(*(plan_settings or ()), *options.overrides),
    )
    return [
        (subject, replace(every, out=options.out / Path(subject).name if options.out and several else options.out))
        for subject in options.subjects
    ]


def _compare(options: argparse.Namespace) -> None:
    from vjepa2_ac.reports.comparison import compare

    comparison = compare(options.runs)

    from vjepa2_ac.console.evaluation import row_tables
    from vjepa2_ac.console.progress import console
    from vjepa2_ac.reports.figures.evaluation import plot_comparison

    for table in row_tables(comparison.rows, comparison.title):
        console.print(table)
    for line in comparison.notes:
        console.print(line)
    console.print(f"  {plot_comparison(comparison, options.out)}")
