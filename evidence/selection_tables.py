"""Write the tables of the selection study: which checkpoint each rule selects, and which metric predicts success.

The short table, about choices between the checkpoints of one run, is also written into docs/evaluation.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
from offline import correlations
from results import Figures
from scipy.stats import spearmanr
from selection import cells_of, run_of
from tables import insert_table

from vjepa2_ac.intervals import estimate_mean, estimate_share
from vjepa2_ac.runs.checkpoint import RunState

MARK = "selection, made by `make evidence`"
KINDS = {"narrow": "low-diversity data", "varied": "diverse data"}
TITLES = {
    "one_step": "one-step error relative to persistence",
    "error": "rollout error relative to persistence, last horizon",
    "shuffled": "growth of the one-step error with shuffled actions",
    "ranking": "**action-ranking error**",
    "spread": "standard deviation of the energy over alternative actions",
}


def _selected(run: list[Figures]) -> Figures:
    """Return the checkpoint that a run with these validations selects."""
    state = RunState(0)
    for checkpoint in run:
        state = replace(state, step=checkpoint["cell"]["step"]).with_validation(
            checkpoint["error"], checkpoint["action_ranking_error"]
        )
    return next(checkpoint for checkpoint in run if checkpoint["cell"]["step"] == state.best_step)


RULES: dict[str, Callable[[list[Figures]], Figures]] = {
    "base": lambda run: run[0],
    "last": lambda run: run[-1],
    "best by error": lambda run: min(run, key=lambda checkpoint: float(checkpoint["error"])),
    "best by ranking": _selected,
}


def write_tables(results: Sequence[Figures], path: Path, docs: Path) -> None:
    """Write the tables and the plot, of runs of which every checkpoint is measured."""
    runs = [run for run in by_run(results) if len(run) == len(cells_of(run_of(run[0])))]
    parts = ("\n".join(_rules(runs)), "\n".join(_correlations(runs)), within_runs(runs), within_runs(runs, first=1))
    path.write_text("\n\n".join(parts) + "\n")
    insert_table(docs / "evaluation.md", MARK, within_runs(runs))
    draw(runs, docs / "ranking.png")


def by_run(results: Sequence[Figures]) -> list[list[Figures]]:
    """Return the checkpoints of each run, by step."""

    def key(checkpoint: Figures) -> tuple[str, str, str, int]:
        cell = checkpoint["cell"]
        return cell["motions"], cell["method"], cell["cure"], cell["seed"]

    ordered = sorted(results, key=lambda checkpoint: (*key(checkpoint), checkpoint["cell"]["step"]))
    return [list(group) for _, group in groupby(ordered, key)]


def _rules(runs: Sequence[list[Figures]]) -> Iterator[str]:
    yield (
        "| demonstrations | trained weights | remedy | selection rule | selected steps | rollout error"
        " | action-ranking error | success rate | final distance, cm |"
    )
    yield "|---" * 9 + "|"
    for kind, group in groupby(runs, lambda run: [run[0]["cell"][name] for name in ("motions", "method", "cure")]):
        runs_of_kind = list(group)
        for rule, select in RULES.items():
            selected = [select(run) for run in runs_of_kind]
            goals, distances = (
                sum(checkpoint["goals"] for checkpoint in selected),
                [checkpoint["left_cm"] for checkpoint in selected],
            )
            share = estimate_share(sum(checkpoint["reached"] for checkpoint in selected), goals)
            row = [
                *(*kind, rule, ", ".join(str(checkpoint["cell"]["step"]) for checkpoint in selected)),
                *(_list([checkpoint[key] for checkpoint in selected], 3) for key in ("error", "action_ranking_error")),
                f"{share.value:.0%} [{share.low:.0%}, {share.high:.0%}] of {goals}",
                f"{np.mean(distances):.1f} ({_list(distances, 1)})",
            ]
            yield f"| {' | '.join(row)} |"


def _list(values: Sequence[float], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _correlations(runs: Sequence[list[Figures]]) -> Iterator[str]:
    """Yield a table of rank correlations with the distance left to the goal; runs are drawn as a whole."""
    results = [checkpoint for run in runs for checkpoint in run if not checkpoint["cell"]["cure"]]
    subsets = {
        name: [checkpoint for checkpoint in results if checkpoint["cell"]["motions"] == name]
        for name in ("narrow", "varied")
    }
    subsets = {"all": results, **subsets}
    columns = [
        correlations(
            [checkpoint["offline"] for checkpoint in subset],
            [checkpoint["left_cm"] for checkpoint in subset],
            list(map(run_of, subset)),
        )
        for subset in subsets.values()
    ]
    yield f"| metric (sign: lower is better), over {len(results)} checkpoints | {' | '.join(subsets)} |"
    yield "|---" * (len(subsets) + 1) + "|"
    for name, title in TITLES.items():
        cells = [
            f"{estimates[name]['value']:+.2f} [{estimates[name]['low']:+.2f}, {estimates[name]['high']:+.2f}]"
            for estimates in columns
        ]
        yield f"| {title} | {' | '.join(cells)} |"


def within_runs(runs: Sequence[list[Figures]], first: int = 0) -> str:
    """Return how well each metric selects one checkpoint of a run, averaged over the runs without replay.

    The rank correlation is Spearman's, between the metric and the final distance from the goal, over the checkpoints of
    one run from number `first` on; checkpoint 0 is the base model. Regret is the distance of the selected checkpoint
    minus the smallest distance of the run.
    """
    groups = [
        [run[first:] for run in runs if run[0]["cell"]["motions"] == kind and not run[0]["cell"]["cure"]]
        for kind in KINDS
    ]
    heads = " | ".join(f"{kind}: rank correlation | 95 % interval | regret, cm" for kind in KINDS.values())
    selectable = "checkpoints and base model" if first == 0 else "checkpoints without the base model"
    rows = [f"| Metric, {selectable} | {heads} |", "|---" * (3 * len(KINDS) + 1) + "|"]
    for name, title in TITLES.items():
        cells = [_correlation_and_regret(group, name) for group in groups]
        rows.append(f"| {title} | {' | '.join(cells)} |")
    for title, distance in (
        ("none: average of all checkpoints", lambda run: np.mean([checkpoint["left_cm"] for checkpoint in run])),
        (f"none: always the {'base model' if first == 0 else 'first checkpoint'}", lambda run: run[0]["left_cm"]),
        ("none: always the last checkpoint", lambda run: run[-1]["left_cm"]),
    ):
        regrets = [np.mean([distance(run) - _shortest_distance(run) for run in group]) for group in groups]
        rows.append(f"| {title} | {' | '.join(f' |  | {regret:.1f}' for regret in regrets)} |")
    return "\n".join(rows)


def _correlation_and_regret(runs: Sequence[list[Figures]], name: str) -> str:
    """Return the mean rank correlation of a metric, its interval over runs, and the mean regret, as three cells."""
    metric = [[checkpoint["offline"][name] for checkpoint in run] for run in runs]
    distances = [[checkpoint["left_cm"] for checkpoint in run] for run in runs]
    pairs = list(zip(metric, distances, strict=True))
    correlations_of_runs = np.array([spearmanr(values, distance).statistic for values, distance in pairs])
    mean = estimate_mean(correlations_of_runs, [str(index) for index in range(len(runs))])
    regret = np.mean([distance[int(np.argmin(values))] - min(distance) for values, distance in pairs])
    return f"{mean.value:.2f} | {mean.low:.2f} to {mean.high:.2f} | {regret:.1f}"


def _shortest_distance(run: Sequence[Figures]) -> float:
    return float(min(checkpoint["left_cm"] for checkpoint in run))


def draw(runs: Sequence[list[Figures]], path: Path) -> None:
    """Plot error, action ranking and closed loop over steps: one line for each seed, one row for each kind of data."""
    from vjepa2_ac.media.figure import new_figure

    figure = new_figure(9.2, 5.4, layout="constrained")
    panels = figure.subplots(2, 3, sharex=True)
    plotted = {
        "error": "rollout error / persistence",
        "action_ranking_error": "action-ranking error",
        "left_cm": "final distance in closed loop, cm",
    }
    names = {"narrow": "Low-diversity data", "varied": "Diverse data", "LoRA": "LoRA", "full": "full fine-tuning"}
    for row, motions in zip(panels, ("narrow", "varied"), strict=True):
        for axes, (key, title) in zip(row, plotted.items(), strict=True):
            for run in runs:
                condition = run[0]["cell"]
                if condition["motions"] != motions or condition["cure"]:
                    continue
                colour = "#1f77b4" if condition["method"] == "LoRA" else "#d62728"
                label = names[condition["method"]] if condition["seed"] == 0 else None
                steps = [checkpoint["cell"]["step"] for checkpoint in run]
                axes.plot(
                    steps, [checkpoint[key] for checkpoint in run], color=colour, marker=".", alpha=0.8, label=label
                )
            axes.set_ylim(bottom=0)
            axes.set_title(f"{names[motions]}\n{title}", fontsize=11)
    for axes in panels[1]:
        axes.set_xlabel("optimizer steps (0: base model)")
    panels[0][0].legend()
    figure.savefig(path, dpi=130)
