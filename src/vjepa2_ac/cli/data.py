"""The data commands: check, inspect, calibrate, convert and converter."""

from __future__ import annotations

import argparse
import contextlib
from dataclasses import asdict
from pathlib import Path

from vjepa2_ac.cli import options as cli
from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError, counted, shell_command
from vjepa2_ac.reporter import INDEXING, SILENT
from vjepa2_ac.storage.structured import format_json, to_plain

_NUM_CLIPS, _NUM_PAIRS = 64, 200  # defaults of --limit for strides and for axes; 200 pairs as in the paper


def add_data(commands: cli.Commands) -> None:
    """Add `data` with its commands to a parser."""
    text = "Check, inspect, calibrate or convert a data set."
    parser = commands.add_parser("data", help=text, description=text)
    cli.add_commands(parser, {"commands": [_add_commands]})


def _add_commands(commands: cli.Commands) -> None:
    such_as, out = "data.camera=wrist_left", Path("inspection")

    parser = cli.add_command(commands, "check", _check, "my_robot.yaml")
    cli.add_config(parser, such_as=such_as)
    cli.add(parser, "--limit N", "number of clips to load (32); --model uses twice as many", cli.count, default=32)
    text = "also measure with a model whether frames are shifted, mirrored, reversed or BGR, or the gripper is inverted"
    cli.add(parser, "--model RUN_OR_MODEL", text, cli.as_model)
    cli.add(parser, "--json", "print one JSON object: the findings and their counts", action="store_true")

    parser = cli.add_command(commands, "inspect", _inspect, "my_robot.yaml --out inspection")
    cli.add_config(parser, such_as=such_as)
    cli.add(parser, "--out DIR", "output folder (inspection)", cli.as_path, default=out)
    cli.add(parser, "--episodes --limit N", "episodes whose motion is analysed (100)", cli.count, default=100)
    cli.add(parser, "--rows N", "episodes on the contact sheet (8)", cli.count, default=8)

    parser = cli.add_command(commands, "calibrate", _calibrate, "my_robot.yaml --limit 64")
    cli.add_config(parser, such_as=such_as)
    cli.add(
        parser,
        "--axes RUN_OR_MODEL",
        "measure the angle between this model's axes and the robot's axes; writes axes.json",
        cli.as_model,
    )
    cli.add(parser, "--model MODEL", "the model to measure: a .pt file, a folder, or a run (model.base)", cli.as_model)
    cli.add(
        parser,
        "--split",
        "episodes to measure (validation)",
        choices=["train", "validation", "test"],
        default="validation",
    )
    cli.add(parser, "--limit N", "clips for each stride (64); with --axes: pairs of frames (200)", cli.count)
    cli.add(parser, "--out DIR", "output folder (inspection)", cli.as_path, default=out)

    parser = cli.add_command(commands, "convert", _convert, "my_robot.yaml data/as_lerobot")
    cli.add(parser, "config CONFIG", "a YAML config", cli.as_local)
    cli.add(parser, "out OUT", "a new or empty folder", cli.as_path)
    cli.add_overrides(parser, f"such as {such_as}")

    parser = cli.add_command(commands, "converter", _converter, "mp4_and_csv > mp4_and_csv.py")
    cli.add(parser, "name NAME", "the script to print", nargs="?")


def _convert(options: argparse.Namespace) -> None:
    """Convert a data set to LeRobot v3.0.

    Tables are written as Parquet, videos as MP4. Whole episodes are written: states, actions, task, success, and all
    cameras in data.camera. Videos are encoded with H.264, which is lossy; all other values are exact. The folder OUT
    is created when the conversion is complete.
    """
    config = cli.read_config(options.config, options.overrides)
    cli.require_new_path(options.out)

    from vjepa2_ac.data.convert import convert_to_lerobot

    with cli.make_reporter() as reporter:
        episodes, steps = convert_to_lerobot(config.data, options.out, reporter)
    written = f"{counted(episodes, 'episode')}, {counted(steps, 'step')}."
    cli.show(f"{written} Next: {shell_command('init', options.out)}", files=[options.out])


def _converter(options: argparse.Namespace) -> None:
    """Print a script that converts another format, for example ROS bags.

    Without NAME the scripts are listed.
    """
    from vjepa2_ac.init.recognize import list_converters, read_converter

    if options.name is not None:
        print(read_converter(options.name), end="")
        return
    for name, about in list_converters().items():
        cli.show(f"{name:<16}{about}")


def _check(options: argparse.Namespace) -> int:
    """Check a data set: read clips as in training, and check all values.

    Each line starts with ok, warning, error or skipped. A skipped check did not run; its line states what it needs.

    Exit status 0: no errors. 1: training would fail or learn nothing. 2: an input cannot be used.
    """
    config = cli.read_config(options.config, options.overrides)
    if options.model is not None:
        cli.require_subject(options.model)
    return check_and_print(config, clips=options.limit, model=options.model, as_json=options.json)


def check_and_print(config: Config, *, clips: int = 32, model: str | None = None, as_json: bool = False) -> int:
    """Check the data of a config and print the findings; return 1 if one of them is an error.

    Args:
        config: The config, for its data set, batch size and seed.
        clips: The approximate number of clips to read; measurements with a model use twice this number.
        model: A run or a model with which the data are measured in addition.
        as_json: Whether to print only one JSON object, after all checks.
    """
    from vjepa2_ac.cli.tables import print_finding, variants_table
    from vjepa2_ac.data.dataset import open_dataset
    from vjepa2_ac.inspection.check import check_data
    from vjepa2_ac.inspection.findings import Finding, findings_as_dict, summarize_findings
    from vjepa2_ac.inspection.probe import probe_config
    from vjepa2_ac.inspection.statistics import with_numeric_stride

    findings: list[Finding] = []

    def add(finding: Finding) -> None:
        findings.append(finding)
        if not as_json:
            print_finding(finding)

    batch_size, probe = config.training.batch_size, None
    with contextlib.nullcontext(SILENT) if as_json else cli.make_reporter() as reporter:
        progress = reporter.task(INDEXING)
        for finding in check_data(config.data, seed=config.seed, batch_size=batch_size, clips=clips, progress=progress):
            add(finding)
        if model is not None:
            dataset, progress = with_numeric_stride(open_dataset(config.data)), reporter.task("probing")
            probe = probe_config(config, dataset, model=model, clips=2 * clips, progress=progress)
    variants = [] if probe is None else [probe.plain, *probe.results]
    if variants and not as_json:
        cli.show(variants_table("One-step error relative to persistence, by variant of the data", variants))
    if probe is not None:
        add(Finding("warning" if probe.better else "ok" if probe.is_decided else "skipped", "probe", probe.verdict()))
    if as_json:
        values = to_plain([asdict(variant) for variant in variants])
        print(format_json({**findings_as_dict(findings), "variants": values}), end="")
    else:
        cli.show(summarize_findings(findings))
    return int(any(finding.level == "error" for finding in findings))


def _inspect(options: argparse.Namespace) -> None:
    """Print the statistics of a data set, and draw a contact sheet."""
    config = cli.read_config(options.config, options.overrides)
    cli.make_folder(options.out)

    from vjepa2_ac.inspection.sheet import plot_dataset
    from vjepa2_ac.inspection.statistics import inspect_dataset, with_numeric_stride

    with cli.make_reporter() as reporter:
        dataset = with_numeric_stride(cli.open_data(config, reporter))
        if config.data.stride == "auto":
            reporter.note(f"data.stride is auto: inspected at the smallest candidate, {dataset.config.stride}")
        inspection = inspect_dataset(dataset, episodes=options.episodes, progress=reporter.task("reading states"))
        cli.show(*(f"{name:<16}{text}" for name, text in inspection.summary.items()))
        values = cli.write_json(options.out / "inspect.json", inspection.values)
        sheet = options.out / "contact_sheet.png"
        plot_dataset(inspection, sheet, rows=options.rows, progress=reporter.task("reading frames"))
    cli.show(files=[sheet, values])


def _calibrate(options: argparse.Namespace) -> int:
    """Find the stride that fits a model, or the rotation of its axes.

    For each stride, the one-step error relative to persistence is measured. With --axes the rotation between the
    model's axes and the robot's axes is measured instead; the exit status is 1 if it cannot be measured.
    """
    config = cli.read_config(options.config, options.overrides, base=options.axes is None)
    if options.axes is not None:
        return _calibrate_axes(options, config)
    if options.model is not None:
        cli.require_subject(options.model)
    cli.make_folder(options.out)

    from vjepa2_ac.cli.tables import variants_table
    from vjepa2_ac.evaluation.measure import ClipSample
    from vjepa2_ac.inspection.variants import calibrate_config

    with cli.make_reporter() as reporter:
        sample = ClipSample(options.split, options.limit or _NUM_CLIPS)
        calibration = calibrate_config(config, sample, model=options.model, reporter=reporter)
    path = cli.write_json(options.out / "calibration.json", calibration.as_dict())
    title = f"One-step error relative to persistence, {options.split} clips of {calibration.frames} frames"
    table = variants_table(title, list(calibration.results.values()), calibration.best)
    reasons = [f"stride {stride} is not possible: {reason}" for stride, reason in calibration.impossible.items()]
    cli.show(table, *reasons, calibration.verdict(), files=[path])
    return 0


def _calibrate_axes(options: argparse.Namespace, config: Config) -> int:
    """Fit the rotation between the model's axes and the robot's; return 1 if it cannot be used for planning."""
    if options.model is not None:
        raise InputError(where="--model", found="--axes and --model together", needed="one of the two options")
    cli.require_subject(options.axes)

    from vjepa2_ac.planning.settings import AXES_FILE, require_calibratable

    require_calibratable(config.data)
    cli.make_folder(options.out)

    from vjepa2_ac.inspection.axes import calibrate_axes

    with cli.make_reporter() as reporter:
        pairs = options.limit or _NUM_PAIRS
        fit, content = calibrate_axes(config, options.axes, pairs=pairs, split=options.split, reporter=reporter)
    cli.show(fit.words(), files=[cli.write_json(options.out / AXES_FILE, content)])
    return int(fit.problem is not None)
