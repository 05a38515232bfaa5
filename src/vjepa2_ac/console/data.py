"""Console output of the data commands: the lines and tables of check, index, inspect and calibrate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table
from rich.text import Text

from vjepa2_ac.console.progress import MetricsTable, console, with_interval
from vjepa2_ac.data.index import EpisodeTable, Usage
from vjepa2_ac.data.inspection.finding import Finding
from vjepa2_ac.data.inspection.statistics import PERCENTILES, Inspection
from vjepa2_ac.evaluation.axis_fit import AxisFit
from vjepa2_ac.evaluation.data_variants.measure import VariantProbe, rows_of
from vjepa2_ac.evaluation.stride_calibration.measure import Calibration

_COLOURS = {"ok": "green", "warning": "yellow", "error": "red"}


def print_finding(finding: Finding) -> None:
    """Print one line of `data check`."""
    level = Text(f"{finding.level:<7}", style=_COLOURS[finding.level])
    console.print(level, console.render_str(f"{finding.about:<16}{finding.text}"), sep="  ")


def index_lines(table: EpisodeTable, watch: Usage, seconds: float) -> list[str]:
    """Return the output of `data index`."""
    lines = [f"{len(table):,} episodes, {int(table.num_steps.sum()):,} steps; opened in {seconds:.2f} s"]
    if table.problems:
        lines.append(f"{len(table.problems):,} broken episodes; the first: {table.problems[0].where}")
    for path in dict.fromkeys(watch.files):
        size = f"{path.stat().st_size / 1e6:.2f} MB" if path.is_file() else "could not be kept"
        lines.append(f"  {path}  {size}")
    return lines


def inspection_lines(inspection: Inspection) -> list[str]:
    """Return the output of `data inspect` before its table."""
    success = inspection.success_share
    known = int((inspection.success >= 0).sum())
    shortest, low, median, high, longest = inspection.length_percentiles
    hours = inspection.hours
    lasting = f"{hours:,.1f} hours" if hours >= 1 else f"{hours * 60:.1f} minutes"
    config, coverage = inspection.config, inspection.coverage
    splits = ", ".join(
        f"{name} {windows:,} clips in {inspection.episodes_of[name]:,} episodes"
        for name, windows in inspection.windows_of.items()
    )
    removed = ", ".join(f"{one.name} {one}" for one in inspection.removed if one.episodes or one.steps)
    rows = {
        "data set": f"{config.path} ({config.source})",
        "episodes": f"{len(inspection.lengths):,} ({inspection.broken:,} broken)",
        "steps": f"{int(inspection.lengths.sum()):,} at {inspection.control_rate_hz:g} per second: {lasting}",
        "length": f"{shortest} / {low} / {median} / {high} / {longest} steps (least, 10 %, median, 90 %, most)",
        "cameras": f"{', '.join(inspection.cameras)}; used: {', '.join(config.cameras)}",
        "success": "not known" if success is None else f"{success:.1%} of {known:,} episodes of which it is known",
        "left out": removed or "nothing",
        "splits": f"{splits}; clips of {config.frames} frames at stride {config.model_stride}",
        "duplicates": str(inspection.duplicates)
        + ("; inspect.json lists the copies" if inspection.duplicates.copies else ""),
        "sample": f"{len(inspection.sample):,} episodes, for what follows",
        **(_pose_rows(inspection) if inspection.has_poses else _vector_rows(inspection)),
        **({} if coverage is None else coverage.lines | {"coverage": coverage.verdict}),
    }
    return [f"{name:<16}{text}" for name, text in rows.items()]


def _pose_rows(inspection: Inspection) -> dict[str, str]:
    gripper = inspection.gripper_range
    limits = [(axis, *inspection.range_of(column)) for column, axis in enumerate("xyz")]
    places = ", ".join(f"{axis} {low:.2f} to {high:.2f}" for axis, low, high in limits)
    return {
        "standing still": f"{inspection.still_share:.1%} of the steps, by the measured motion",
        "position": f"{places} m",
        "gripper": f"{gripper[0]:.2f} to {gripper[1]:.2f} (0 open, 1 closed)",
    }


def _vector_rows(inspection: Inspection) -> dict[str, str]:
    config, widths = inspection.config, inspection.widths
    ranges = ", ".join(f"{low:.2f} to {high:.2f}" for low, high in inspection.ranges)
    how = f", joined by {config.join_actions}" if config.join_actions else ""
    return {"states": f"{widths.state} numbers: {ranges}", "actions": f"{widths.action} numbers, {config.actions}{how}"}


def motion_table(inspection: Inspection) -> Table:
    """Return the percentiles of the motion, or of the change of vectors, per model step at several strides."""
    rows: list[tuple[Any, ...]]
    if inspection.has_poses:
        what, columns = "Motion", ["moves by (cm)", "turns by (degrees)"]
        rows = [(one, one.percentiles("moved_cm"), one.percentiles("turned_deg")) for one in inspection.motions]
    else:
        what, columns = "Change", ["the number that changes most (% of its range)"]
        rows = [(one, one.percentiles(PERCENTILES)) for one in inspection.changes]
    table = MetricsTable(f"{what} per model step: 10 / 50 / 90 / 99 %", ["stride", "seconds", *columns], labelled=False)
    for one, *metrics in rows:
        cells = (" / ".join(f"{value:.1f}" for value in values) or "no step fits" for values in metrics)
        table.add_row(str(one.stride), f"{one.seconds:.2f}", *cells)
    return table


def probe_table(probe: VariantProbe) -> Table:
    """Return the table of `data check --model`."""
    columns = ["variant", "error / persistence", "difference"]
    table = MetricsTable("One-step error / persistence of the data, read otherwise", columns)
    for row in rows_of(probe):
        table.add_row(*row)
    return table


def calibration_table(calibration: Calibration) -> Table:
    """Return the table of `data calibrate`."""
    table = MetricsTable(
        f"One-step error / persistence on {calibration.split} episodes, {calibration.frames} frames a clip"
        " (95 % interval over episodes)",
        ["stride", "seconds", "error / persistence", "error", "persistence", "moves by", "clips (episodes)"],
        labelled=False,
    )
    for one in calibration.results:
        mark = " <" if one is calibration.best else ""
        moved = "" if one.moved_cm is None else f"{one.moved_cm:.1f} cm"
        table.add_row(
            f"{one.stride}{mark}", f"{one.seconds_per_step:.2f}", str(one.ratio), f"{one.error:.4f}",
            f"{one.persistence:.4f}", moved, f"{one.clips} ({one.episodes})",
        )  # fmt: skip
    reasons = [f"stride {stride} is not possible: {reason}" for stride, reason in calibration.impossible.items()]
    table.caption = "\n".join(reasons) or None
    return table


def axes_table(fits: Mapping[str, AxisFit]) -> Table:
    """Return the table of `data calibrate --axes`: a row for each model."""
    title = "Yaw of least error, and fit of inferred to executed moves (95 % interval over episodes)"
    names = ["yaw, degrees", "error / unturned", "fitted yaw", "gain", "condition", "off by, cm", "pairs (episodes)"]
    table = MetricsTable(title, ["model", *names])
    for name, fit in fits.items():
        yaws = [with_interval(yaw, ".1f") for yaw in (fit.yaw_degrees, fit.fitted_yaw_degrees)]
        numbers = map(str, (fit.gain, fit.condition, fit.residual_cm))
        table.add_row(name, yaws[0], str(fit.error), yaws[1], *numbers, f"{fit.pairs} ({fit.episodes})")
    return table
