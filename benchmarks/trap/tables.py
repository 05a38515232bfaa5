"""Which checkpoint would each rule have taken, how does it plan, and which offline figure tells?"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from runs import Run, cells_of
from scipy.stats import rankdata

from vjepa2_ac.intervals import share_of
from vjepa2_ac.runs.checkpoint import RunState
from vjepa2_ac.storage import write_atomically

Figures = dict[str, Any]
REACHED_CM = 5.0
ALL, FEWEST = "simulated arm, all changes", 9  # cells of a correlation
GONE = {"contrast": "a loss term, `training.action_contrast`: measured at commit 6117de8, the last with the term"}
"""Cures that no longer can be run, whose measurements stay."""
_SHOWN = ("rollout_over_persistence_last", "action_ranking_error")


def _selected(cells: list[Figures]) -> Figures:
    """Return the checkpoint that a run with these validations selects."""
    state = RunState(0)
    for one in cells:
        error, rank = (one["validation"][key] for key in _SHOWN)
        state = replace(state, step=one["cell"]["step"]).measured(error, rank)
    return next(one for one in cells if one["cell"]["step"] == state.best_step)


RULES: dict[str, Callable[[list[Figures]], Figures]] = {
    "base": lambda cells: cells[0],
    "last": lambda cells: cells[-1],
    "best by error": lambda cells: min(cells, key=lambda one: one["validation"]["rollout_over_persistence_last"]),
    "best by ranking": _selected,
}


def read_cells(out: Path) -> dict[str, Figures]:
    """Return the checkpoints that are measured, by name."""
    path = out / "trap.json"
    return json.loads(path.read_text()) if path.exists() else {}


def write_cells(out: Path, cells: dict[str, Figures]) -> None:
    """Write them."""
    write_atomically(out / "trap.json", json.dumps(dict(sorted(cells.items())), indent=0).encode())


def write_tables(out: Path, picture: Path | None) -> None:
    """Write the tables, and the picture if a place is given; of runs of which all is measured."""
    found = read_cells(out).values()
    cells = [one for run in by_run(list(found)) if len(run) == len(cells_of(_run_of(run))) for one in run]
    if not cells:
        return
    text = "\n".join([*_rules(cells), "", *_notes(cells), *_correlations(cells), "", *_of_evidence(out)])
    (out / "trap.md").write_text(text + "\n")
    print(text)
    if picture is not None:
        draw(cells, picture)


def _run_of(cells: list[Figures]) -> Run:
    return Run(**{key: value for key, value in cells[0]["cell"].items() if key not in {"step", "name"}})


def left_cm(one: Figures) -> float:
    """Return the mean distance to the goal at the end."""
    return float(np.mean([way[-1] for way in one["distance_cm"]]))


def reached(one: Figures) -> int:
    """Return how many goals were reached."""
    return sum(way[-1] < REACHED_CM for way in one["distance_cm"])


def by_run(cells: Sequence[Figures]) -> Iterator[list[Figures]]:
    """Yield the checkpoints of each run, by step."""

    def key(one: Figures) -> tuple[Any, ...]:
        return tuple(one["cell"][name] for name in ("motions", "method", "cure", "seed"))

    for _, group in groupby(sorted(cells, key=lambda one: (*key(one), one["cell"]["step"])), key):
        yield list(group)


def _rules(cells: Sequence[Figures]) -> Iterator[str]:
    yield "| demonstrations | trained | cure | rule | steps | error | rank | goals reached | left at the end, cm |"
    yield "|---" * 9 + "|"
    runs = list(by_run(cells))
    for kind, group in groupby(runs, lambda run: [run[0]["cell"][name] for name in ("motions", "method", "cure")]):
        of_kind = list(group)
        for rule, choose in RULES.items():
            chosen = [choose(run) for run in of_kind]
            goals = sum(len(one["distance_cm"]) for one in chosen)
            share = share_of(sum(map(reached, chosen)), goals)
            row = [
                *(*kind, rule, _list([one["cell"]["step"] for one in chosen], "d")),
                *(_list([one["validation"][key] for one in chosen], ".3f") for key in _SHOWN),
                f"{share.value:.0%} [{share.low:.0%}, {share.high:.0%}] of {goals}",
                f"{np.mean([left_cm(one) for one in chosen]):.1f} ({_list([left_cm(one) for one in chosen], '.1f')})",
            ]
            yield f"| {' | '.join(row)} |"


def _notes(cells: Sequence[Figures]) -> Iterator[str]:
    """Yield a line, and an empty one, for each cure in the table that is gone."""
    for cure in sorted({one["cell"]["cure"] for one in cells} & GONE.keys()):
        yield from (f"The cure `{cure}` is gone. It was {GONE[cure]}.", "")


def _list(values: Sequence[float], form: str) -> str:
    return ", ".join(f"{value:{form}}" for value in values)


def _correlations(cells: Sequence[Figures], draws: int = 1000) -> Iterator[str]:
    """Yield a table of rank correlations with what is left to the goal; intervals are over whole runs."""
    runs = [run for run in by_run(cells) if not run[0]["cell"]["cure"]]
    parts = {name: [run for run in runs if run[0]["cell"]["motions"] == name] for name in ("narrow", "varied")}
    parts = {"all": runs, **parts}
    yield f"| offline figure, over {sum(map(len, runs))} checkpoints of {len(runs)} runs | {' | '.join(parts)} |"
    yield "|---" * (len(parts) + 1) + "|"
    for name in [name for name in cells[0]["offline"] if all(name in one["offline"] for one in cells)]:
        found = [_interval(part, name, draws) if len(part) > 1 else "" for part in parts.values()]
        yield f"| {name} | {' | '.join(found)} |"


def _of_evidence(out: Path) -> Iterator[str]:
    """Yield the same of the errors of the evidence, each cell being a run; nothing if it is not there.

    Distances at the end are those of the hand on the simulated arm, and of the object in third-party environments, so
    only the former are pooled. A world with fewer than `FEWEST` cells has no row.
    """
    path = out / "evidence.json"
    if not path.exists():
        return
    cells = [one for one in json.loads(path.read_text()) if "shifted" in one and "reach" in one]
    by_world: dict[str, list[np.ndarray]] = {}
    for one in cells:
        reach = one["reach"]["l1"]
        pair = np.array([[one["shifted"]["rollout_over_persistence"][-1], left_cm(reach)]])
        world = f"{one['cell']['shift']}, base of {one['cell']['base']}"
        by_world.setdefault(world, []).append(pair)
        if "solved" not in reach:  # only third-party environments say what is solved
            by_world.setdefault(ALL, []).append(pair)
    yield "| rollout error / persistence and distance at the end, in the evidence | cells | correlation |"
    yield "|---|---|---|"
    for name in sorted(by_world, key=lambda name: (name != ALL, name)):
        if len(by_world[name]) >= FEWEST:
            yield f"| {name} | {len(by_world[name])} | {_with_interval(by_world[name], 1000)} |"


def _interval(runs: Sequence[list[Figures]], name: str, draws: int) -> str:
    return _with_interval([np.array([[one["offline"][name], left_cm(one)] for one in run]) for run in runs], draws)


def _with_interval(pairs: Sequence[np.ndarray], draws: int) -> str:
    """Return the rank correlation of pairs of numbers, in groups that are drawn as a whole for the interval."""
    rng = np.random.default_rng(0)
    drawn = [
        _spearman(np.concatenate([pairs[place] for place in rng.integers(len(pairs), size=len(pairs))]))
        for _ in range(draws)
    ]
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    return f"{_spearman(np.concatenate(pairs)):+.2f} [{low:+.2f}, {high:+.2f}]"


def _spearman(pairs: np.ndarray) -> float:
    """Return the correlation of ranks; scipy's own takes a p-value's time, a thousand times."""
    ranks = rankdata(pairs, axis=0)
    with np.errstate(invalid="ignore"):
        return float(np.corrcoef(ranks.T)[0, 1])


def draw(cells: Sequence[Figures], path: Path) -> None:
    """Draw error, ranking and closed loop over steps, a line for each seed: narrow above, varied below."""
    from vjepa2_ac.media.figure import new_figure

    figure = new_figure(9.2, 5.4, layout="constrained")
    panels = figure.subplots(2, 3, sharex=True)
    shown: dict[str, Callable[[Figures], float]] = {
        "error / persistence": lambda one: one["validation"]["rollout_over_persistence_last"],
        "action-ranking error": lambda one: one["validation"]["action_ranking_error"],
        "cm left in closed loop": left_cm,
    }
    for row, motions in zip(panels, ("narrow", "varied"), strict=True):
        for axes, (title, figure_of) in zip(row, shown.items(), strict=True):
            for run in by_run(cells):
                about = run[0]["cell"]
                if about["motions"] != motions or about["cure"]:
                    continue
                colour = "#1f77b4" if about["method"] == "LoRA" else "#d62728"
                label = about["method"] if about["seed"] == 0 else None
                steps = [one["cell"]["step"] for one in run]
                axes.plot(steps, [figure_of(one) for one in run], color=colour, marker=".", alpha=0.8, label=label)
            axes.set_ylim(bottom=0)
            axes.set_title(f"{motions} data: {title}", fontsize=10)
    for axes in panels[1]:
        axes.set_xlabel("optimizer steps (0: the base)")
    panels[0][0].legend()
    figure.savefig(path, dpi=130)
