"""Write the tables of the iterations study: quality of a decision and success rate, by the size of the search."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from iterations import ITERATIONS, REFERENCE, SAMPLES, SETTINGS, TASKS
from jaxtyping import Float
from results import Figures
from scipy.stats import binomtest
from tables import correct_by_holm, insert_table

from vjepa2_ac.intervals import Estimate, estimate_mean, estimate_ratio, estimate_share

Search = tuple[int, int]  # samples, iterations
DECISIONS_HEAD = (
    "samples",
    "iterations",
    "action sequences",
    "difference from 800 x 10, cm",
    "95 % interval",
    "energy reduction",
    "95 % interval",
    "difference from the oracle, cm",
    "95 % interval",
    "seconds on one core",
)
NEEDED = 3  # number of searches in closed loop that the page needs
MARKS = tuple(f"{name}, made by `make evidence`" for name in ("decisions", "searches in closed loop"))


def write_tables(results: Sequence[Figures], path: Path, docs: Path) -> None:
    """Write all tables to a file, and into docs/planning.md those whose needed cells are all measured."""
    if not results:
        return
    measured = {tuple(result["cell"].values()) for result in results}  # kind, task, samples, iterations
    tasks = [task for task in TASKS if ("decisions", task, *REFERENCE) in measured]
    parts = []
    if tasks:
        parts.append(f"**All tasks**, one decision\n\n{decisions_table(results, tasks)}")
        parts += [f"**{TASKS[task].title}**, one decision\n\n{decisions_table(results, [task])}" for task in tasks]
    if closed_loop := closed_loop_table(results):
        parts.append(f"**Closed loop**\n\n{closed_loop}")
    path.write_text("\n\n".join(parts) + "\n")
    decisions_mark, searches_mark = MARKS
    if len(tasks) == len(TASKS):
        insert_table(docs / "planning.md", decisions_mark, decisions_table(results, tasks))
    if {("closed loop", task, *search) for task in TASKS for search in SETTINGS[:NEEDED]} <= measured:
        insert_table(docs / "planning.md", searches_mark, closed_loop)


def count_sequences(search: Search) -> int:
    """Return the number of action sequences that a search evaluates."""
    return search[0] * search[1]


# ---- one decision ----


def decisions_table(results: Sequence[Figures], tasks: Sequence[str]) -> str:
    """Return the quality of one decision for each size of the search, over all starts of the tasks.

    The energy reduction is the fall in energy from the zero action to the plan, divided by that of the reference, each
    summed over all starts. The intervals are from a bootstrap over starts.
    """
    rows = [f"| {' | '.join(DECISIONS_HEAD)} |", "|---" * len(DECISIONS_HEAD) + "|"]
    reference = np.concatenate([get_search(results, task, REFERENCE) for task in tasks])
    oracle = np.concatenate([get_result(results, task, REFERENCE[0])["oracle"] for task in tasks])
    zero = np.concatenate([get_result(results, task, REFERENCE[0])["zero_action_energy"] for task in tasks])
    names = [f"{number:06d}" for number in range(len(zero))]
    for search in ((samples, iterations) for samples in SAMPLES for iterations in ITERATIONS):
        if any(not get_result(results, task, search[0]) for task in tasks):
            continue
        planned = np.concatenate([get_search(results, task, search) for task in tasks])
        difference = estimate_mean(measure_distances(planned[:, :3], reference[:, :3]), names)
        reduction = estimate_ratio(100 * (zero - planned[:, 3]), zero - reference[:, 3], names)
        from_oracle = estimate_mean(measure_distances(planned[:, :3], oracle), names)
        is_reference = search == REFERENCE
        cells = (
            *map(str, search),
            f"{count_sequences(search):,}",
            *(("reference", "") if is_reference else _show(difference, ".2f", "")),
            *(("100 %", "") if is_reference else _show(reduction, ".1f", " %")),
            *_show(from_oracle, ".2f", ""),
            f"{planned[:, 4].mean():.2f}",
        )
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def get_result(results: Sequence[Figures], task: str, samples: int) -> Figures:
    """Return the decisions of a task with this number of samples; empty if they are not measured."""
    keys = {"kind": "decisions", "task": task, "samples": samples}
    return next((result for result in results if result["cell"].items() >= keys.items()), {})


def get_search(results: Sequence[Figures], task: str, search: Search) -> Float[np.ndarray, "starts 5"]:
    """Return dx, dy, dz (cm), energy and seconds of each decision."""
    return np.array(get_result(results, task, search[0])["searches"][str(search[1])])


def measure_distances(
    first: Float[np.ndarray, "starts 3"], second: Float[np.ndarray, "starts 3"]
) -> Float[np.ndarray, " starts"]:
    """Return the distances between the translations of two actions at each start."""
    return np.asarray(np.linalg.norm(first - second, axis=1))


def _show(estimate: Estimate, form: str, unit: str) -> tuple[str, str]:
    """Return an estimate and its interval as two cells of a table."""
    return f"{estimate.value:{form}}{unit}", f"{estimate.low:{form}} to {estimate.high:{form}}{unit}"


# ---- closed loop ----


def closed_loop_table(results: Sequence[Figures]) -> str:
    """Return the success rate of each search, compared with the search with the most action sequences.

    Only searches that are measured on all tasks are compared. The difference is that of the success rate over all
    problems, with a bootstrap interval over problems, which are the same for all searches. The p-value is from
    McNemar's exact test, corrected for the number of comparisons (Holm).
    """
    solved: dict[Search, dict[str, list[int]]] = {}
    for result in results:
        cell = result["cell"]
        if cell["kind"] == "closed loop":
            solved.setdefault((cell["samples"], cell["iterations"]), {})[cell["task"]] = result["solved"]
    complete = [search for search in sorted(solved, key=count_sequences) if len(solved[search]) == len(TASKS)]
    if not complete:
        return ""
    flags = {search: np.concatenate([solved[search][task] for task in TASKS]) for search in complete}
    *smaller, largest = complete
    corrected = correct_by_holm([_mcnemar(flags[search], flags[largest]) for search in smaller])
    p_values = dict(zip(smaller, corrected, strict=True))
    heads = (
        *("samples", "iterations", "action sequences"),
        *(TASKS[task].title for task in TASKS),
        *("all tasks", "95 % interval"),
        *(f"difference from {largest[0]} x {largest[1]}", "95 % interval", "p, corrected"),
    )
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for search in complete:
        share = estimate_share(int(flags[search].sum()), len(flags[search]))
        cells = (
            *map(str, search),
            f"{count_sequences(search):,}",
            *(f"{100 * np.mean(solved[search][task]):.0f} %" for task in TASKS),
            f"{100 * share.value:.0f} %",
            f"{100 * share.low:.0f} to {100 * share.high:.0f} %",
            *_compare(flags[search], flags[largest], p_values.get(search)),
        )
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def _compare(flags: np.ndarray, reference: np.ndarray, p_value: float | None) -> Iterator[str]:
    """Yield the difference of the success rate in points, its interval, and the p-value (None: the reference)."""
    if p_value is None:
        yield from ("reference", "", "")
        return
    difference = estimate_mean(100.0 * (flags - reference), [f"{number:06d}" for number in range(len(flags))])
    yield f"{difference.value:+.1f} points"
    yield f"{difference.low:+.1f} to {difference.high:+.1f} points"
    yield f"{p_value:.3f}" if p_value >= 0.0005 else "< 0.001"


def _mcnemar(flags: np.ndarray, reference: np.ndarray) -> float:
    """Return the p-value of McNemar's exact test (1947); 1 if both searches solve the same problems."""
    won, lost = int((flags > reference).sum()), int((flags < reference).sum())
    return float(binomtest(won, won + lost).pvalue) if won + lost else 1.0
