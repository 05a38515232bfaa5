"""Write the tables of the selection study: which checkpoint each rule selects, and which metric predicts success."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
from offline import correlations
from results import Figures
from selection import cells_of, run_of

from vjepa2_ac.intervals import estimate_share
from vjepa2_ac.runs.checkpoint import RunState

TITLES = {
    "one_step": "one-step error relative to persistence",
    "error": "rollout error relative to persistence, last horizon",
    "shuffled": "growth of the error with shuffled actions, negated",
    "ranking": "action-ranking error (selects checkpoints)",
    "spread": "standard deviation of the energy, negated",
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
    """Write the table and the plot, of runs of which every checkpoint is measured."""
    runs = [run for run in by_run(results) if len(run) == len(cells_of(run_of(run[0])))]
    path.write_text("\n".join([*_rules(runs), "", *_correlations(runs)]) + "\n")
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
    yield f"| metric, over {len(results)} checkpoints | {' | '.join(subsets)} |"
    yield "|---" * (len(subsets) + 1) + "|"
    for name, title in TITLES.items():
        cells = [
            f"{estimates[name]['value']:+.2f} [{estimates[name]['low']:+.2f}, {estimates[name]['high']:+.2f}]"
            for estimates in columns
        ]
        yield f"| {title} | {' | '.join(cells)} |"


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
