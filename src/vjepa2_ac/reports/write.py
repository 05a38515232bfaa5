"""The report of an evaluation: measured, and written as metrics.json, report.html and evaluation.png."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.calibration.axes import infer_axes
from vjepa2_ac.calibration.variants import calibrate_model
from vjepa2_ac.evaluation.estimates import Curve, over_persistence
from vjepa2_ac.evaluation.evaluate_run import measure_subject
from vjepa2_ac.evaluation.request import EvaluationOptions
from vjepa2_ac.evaluation.result import Evaluation
from vjepa2_ac.evaluation.verdict import verdict
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.reports.figures.evaluation import plot_evaluation
from vjepa2_ac.reports.metrics_json import METRICS_FILE, write_metrics
from vjepa2_ac.reports.page import write_report

PLOT, REPORT = "evaluation.png", "report.html"


@dataclass(frozen=True)
class Evaluated:
    """The result of an evaluation, and its files."""

    evaluation: Evaluation
    files: tuple[Path, ...]  # written files

    @property
    def verdict(self) -> str:
        """Whether training helped, how certain that is, and whether the actions are used, as text."""
        return verdict(self.evaluation)

    @property
    def error_over_persistence(self) -> dict[str, Curve]:
        """The L1 error of each model's rollout over that of copying the first frame, by horizon (index h - 1)."""
        return {name: over_persistence(one.errors, "rollout") for name, one in self.evaluation.models.items()}


def evaluate_subject(subject: str, asked: EvaluationOptions | None = None, reporter: Reporter = SILENT) -> Evaluated:
    """Measure as `measure_subject` does, and write metrics.json, report and figure.

    Raises:
        InputError: As `measure_subject`.
    """
    asked = asked or EvaluationOptions()
    evaluation = measure_subject(subject, asked, reporter=reporter, find_axes=infer_axes, calibrate=calibrate_model)
    folder = asked.out or Path(subject)
    files = (
        plot_evaluation(evaluation, folder / PLOT),
        write_metrics(evaluation, folder / METRICS_FILE),
        write_report(evaluation, folder / REPORT),
    )
    return Evaluated(evaluation, files)
