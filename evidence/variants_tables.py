"""Write the tables of the variants study: the difference of each method to the baseline, and which methods are kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from failing_variants import FAMILIES
from results import REACHED_CM, Figures
from scipy import stats
from variants import BASE, BASELINE, METHODS, SEEDS

from vjepa2_ac.intervals import Estimate

Results = dict[str, dict[int, Figures]]  # by method and seed


@dataclass(frozen=True)
class Measure:
    """A metric of a cell."""

    title: str
    read: Callable[[Figures], float]
    is_higher_better: bool = False
    form: str = ".3f"


SUCCESS = Measure(
    "success rate, %",
    lambda result: 100 * float(np.mean([end < REACHED_CM for end in result["ends_cm"]])),
    is_higher_better=True,
    form=".1f",
)
MEASURES = (
    SUCCESS,
    Measure("final distance to the goal, cm", lambda result: float(np.mean(result["ends_cm"])), form=".2f"),
    Measure("action-ranking error, %", lambda result: 100 * float(result["action_ranking_error"]), form=".1f"),
    Measure("AUROC, all starts", lambda result: float(result["auroc"]), is_higher_better=True),
    Measure("AUROC, same start", lambda result: float(result["auroc_same_start"]), is_higher_better=True),
    Measure("common error / persistence", lambda result: float(result["common_error"])),
    Measure("action-relative error / persistence", lambda result: float(result["relative_error"])),
    Measure("rollout error / persistence, 3 steps", lambda result: float(result["rollout_over_persistence"][2])),
    Measure("rollout error / persistence, 10 steps", lambda result: float(result["rollout_over_persistence"][-1])),
)
SHARE = Measure("common part of the squared error, %", lambda result: 100 * float(result["common_share"]), form=".0f")
NOTES = """- Each seed has its own target domain, demonstrations, order of clips and goals.
- *Difference*: mean over seeds of method minus reference, with the interval of Student's t over the seeds. These
  intervals are not corrected for the number of comparisons.
- *AUROC*: the probability that the predicted energy of a held-out demonstration is lower than that of a failing
  variant, over all starts or for the same start. 0.5 is chance.
- *Common* and *action-relative error*: parts of the mean square error after 4 model steps, relative to the same part of
  persistence. The common part is the mean over alternative actions from the same start. An action-relative error of 1
  is that of a model that ignores the actions.
- *Kept*: "yes" if the interval of the difference in the success rate is above 0, compared with the baseline and, if the
  method has one, with its control, which has the same data without the idea that is tested."""


def write_tables(results: Sequence[Figures], path: Path, docs: Path) -> None:  # noqa: ARG001 - no table in a page yet
    """Write all tables to a file, from the seeds of which every method is measured."""
    methods = group_by_method(results)
    if not methods:
        return
    controls = {name: method.control for name, method in METHODS.items() if method.control}
    to_baseline = dict.fromkeys((name for name in METHODS if name != BASELINE), BASELINE)
    count = len(methods[BASELINE])
    parts = [
        f"{count} of {SEEDS} seeds are measured.",
        decision_table(methods),
        means_table(methods),
        f"**Differences to the baseline**\n\n{differences_table(methods, to_baseline)}",
        f"**Differences to the control**\n\n{differences_table(methods, controls)}",
        f"**AUROC of each family of failing variants, all starts**\n\n{families_table(methods)}",
        NOTES,
    ]
    path.write_text("\n\n".join(parts) + "\n")


def group_by_method(results: Sequence[Figures]) -> Results:
    """Return the results by method and seed, of the seeds of which every method is measured."""
    names = (BASE, *METHODS)
    measured = {(result["cell"]["method"], result["cell"]["seed"]): result for result in results}
    seeds = sorted({seed for _, seed in measured if all((name, seed) in measured for name in names)})
    return {name: {seed: measured[name, seed] for seed in seeds} for name in names} if seeds else {}


def estimate_difference(methods: Results, measure: Measure, method: str, reference: str) -> Estimate:
    """Return the mean over seeds of method minus reference, with the 95 % interval of Student's t."""
    differences = np.array(
        [measure.read(methods[method][seed]) - measure.read(result) for seed, result in methods[reference].items()]
    )
    count, mean = len(differences), float(differences.mean())
    if count < 2:
        return Estimate(mean, float("nan"), float("nan"))
    half = float(stats.t.ppf(0.975, count - 1) * differences.std(ddof=1) / np.sqrt(count))
    return Estimate(mean, mean - half, mean + half)


def is_gain(difference: Estimate, measure: Measure) -> bool:
    """Return whether a difference is an improvement, and its interval excludes 0."""
    return difference.compare_to(0.0) == (1 if measure.is_higher_better else -1)


def is_kept(methods: Results, method: str) -> bool | None:
    """Return whether a method gains success over the baseline and its control; None before all seeds are measured."""
    if len(methods[BASELINE]) < SEEDS:
        return None
    references = [BASELINE, METHODS[method].control]
    return all(is_gain(estimate_difference(methods, SUCCESS, method, name), SUCCESS) for name in references if name)


def decision_table(methods: Results) -> str:
    """Return the difference of each method in the success rate, and whether the method is kept."""
    rows = []
    for method in METHODS:
        if method == BASELINE:
            continue
        difference = estimate_difference(methods, SUCCESS, method, BASELINE)
        kept = {True: "yes", False: "no", None: "undecided"}[is_kept(methods, method)]
        control = METHODS[method].control or ""
        rows.append((method, f"{difference.value:+.1f} points", _format_interval(difference, SUCCESS), control, kept))
    heads = ("method", "difference in the success rate", "95 % interval", "control", "kept")
    return _format_table(heads, rows)


def means_table(methods: Results) -> str:
    """Return each measure of each method, as the mean over seeds."""
    measures = (*MEASURES, SHARE)
    rows = [
        (
            name,
            *(f"{np.mean([measure.read(result) for result in seeds.values()]):{measure.form}}" for measure in measures),
        )
        for name, seeds in methods.items()
    ]
    return _format_table(("method", *(measure.title for measure in measures)), rows)


def differences_table(methods: Results, references: Mapping[str, str]) -> str:
    """Return the difference of every measure between each method and its reference."""
    rows = []
    for name, reference in references.items():
        for measure in MEASURES:
            difference = estimate_difference(methods, measure, name, reference)
            value = f"{difference.value:+{measure.form}}"
            gain = "yes" if is_gain(difference, measure) else "no"
            rows.append((name, measure.title, value, _format_interval(difference, measure), gain))
    return _format_table(("method", "measure", "difference", "95 % interval", "gain beyond the interval"), rows)


def families_table(methods: Results) -> str:
    """Return the AUROC of each family of failing variants, as the mean over seeds."""
    rows = [
        (
            name,
            *(
                f"{np.nanmean([result['auroc_by_family'][family] for result in seeds.values()]):.3f}"
                for family in FAMILIES
            ),
        )
        for name, seeds in methods.items()
    ]
    return _format_table(("method", *FAMILIES), rows)


def _format_interval(difference: Estimate, measure: Measure) -> str:
    if not difference.has_interval:
        return "needs two seeds"
    return f"{difference.low:+{measure.form}} to {difference.high:+{measure.form}}"


def _format_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *(f"| {' | '.join(row)} |" for row in rows)]
    return "\n".join(lines)
