"""Console output of the data commands: the lines and tables of check, index, inspect and calibrate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.table import Table
from rich.text import Text

from vjepa2_ac.console.progress import MetricsTable, console, with_interval
from vjepa2_ac.data.index.episode_table import EpisodeTable
from vjepa2_ac.data.index.index_cache import Usage
from vjepa2_ac.evaluation.axis_fit import AxisFit
from vjepa2_ac.evaluation.data_variants.measure import VariantProbe, rows_of
from vjepa2_ac.evaluation.stride_calibration.measure import Calibration
from vjepa2_ac.inspection.excerpts import Finding
from vjepa2_ac.inspection.statistics import CHANGED, MOVED, TURNED, StepSizes

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


_SIZES = {
    MOVED: "moves by (cm)",
    TURNED: "turns by (degrees)",
    CHANGED: "the number that changes most (% of its range)",
}


def motion_table(steps: Sequence[StepSizes]) -> Table:
    """Return the percentiles of the motion, or of the change of vectors, per model step at several strides."""
    names = list(steps[0].sizes)
    title = f"{'Change' if CHANGED in names else 'Motion'} per model step: 10 / 50 / 90 / 99 %"
    table = MetricsTable(title, ["stride", "seconds", *(_SIZES[name] for name in names)], labelled=False)
    for one in steps:
        cells = [" / ".join(f"{value:.1f}" for value in row) or "no step fits" for row in one.percentiles.values()]
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
