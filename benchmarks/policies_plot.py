"""Draw docs/policies.png from what benchmarks/policies.py has measured: a panel for each of its questions.

python benchmarks/policies_plot.py [--rows benchmarks/results/policies.json] [--out docs/policies.png]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from vjepa2_ac.media.figure import written_figure

TASKS = {"reach": "#1f77b4", "push": "#d62728", "pick": "#2ca02c"}
SEARCHES = ("search", "search, a quarter", "search, a twentieth")
WITH_PRIOR = ("from the prior", "from the prior, a quarter", "from the prior, a twentieth", "prior alone")
PROPOSALS = ("best of 8, untrained", "one", "best of 8", "mean")
POLICIES = {"hasty": 30, "short": 200, "whole": 2000}  # steps of training
DISTURBANCES = ("light out", "moved camera", "pushed arm", "blocked gripper", "dropped block")


def main() -> None:
    """Draw what there is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=Path, default=Path("benchmarks/results/policies.json"))
    parser.add_argument("--out", type=Path, default=Path("docs/policies.png"))
    options = parser.parse_args()
    draw(json.loads(options.rows.read_text()), options.out)


def draw(rows: dict[str, Any], path: Path) -> None:
    """Draw four panels: the prior in a search, a judge of proposals, policies in order, alarms."""
    found = {(key.split(" ")[0], key.split(" ")[2], key.split(": ", 1)[1]): value for key, value in rows.items()}
    with written_figure(path, 9.2, 7.2, dpi=110) as figure:
        (search, judge), (order, alarms) = figure.subplots(2, 2)
        _search(search, found)
        _judge(judge, found)
        _order(order, found["order", "reach", "three policies"])
        _alarms(alarms, found)


Rows = dict[tuple[str, str, str], Any]  # part, task, name


def _search(axes: Any, found: Rows) -> None:
    for task, colour in TASKS.items():
        for names, line, marker in ((SEARCHES, "--", "o"), (WITH_PRIOR, "-", "s")):
            there = [found["prior", task, name] for name in names if ("prior", task, name) in found]
            at, shares = [one["ms"] for one in there], [one["solved"] for one in there]
            values, label = [one["value"] for one in shares], task if names is WITH_PRIOR else None
            axes.errorbar(at, values, yerr=_error(shares), fmt=line + marker, color=colour, capsize=2, label=label)
    axes.set(xscale="log", xlabel="milliseconds a decision", ylabel="solved", ylim=(-0.05, 1.05))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_title("With a prior (squares), and search alone")
    axes.legend()


def _judge(axes: Any, found: Rows) -> None:
    for place, task in enumerate(one for one in TASKS if ("judge", one, "one") in found):
        shares = [found["judge", task, name]["solved"] for name in PROPOSALS]
        at, values = np.arange(len(shares)) + 0.35 * place, [one["value"] for one in shares]
        axes.bar(at, values, 0.33, yerr=_error(shares), capsize=2, color=TASKS[task], label=task)
    axes.set_xticks(np.arange(len(PROPOSALS)) + 0.17, [one.replace(", ", ",\n") for one in PROPOSALS])
    axes.set(ylabel="solved", ylim=(0, 1.05))
    axes.set_title("Eight noisy proposals: which is done?")
    axes.legend()


def _order(axes: Any, row: dict[str, Any]) -> None:
    energies = {one["name"]: one["mean"] for one in row["scores"]["policies"]}
    for name, steps in POLICIES.items():
        left, energy = row["left_cm"][name], energies[name]
        axes.errorbar(
            energy["value"], left["value"], xerr=_error([energy]), yerr=_error([left]), marker="o", capsize=2,
            label=f"{steps:,} steps of training",
        )  # fmt: skip
    axes.set(xlabel="energy of what it would do, over doing nothing", ylabel="cm left in closed loop")
    axes.set_title("Three policies, without and with a robot")
    axes.legend()


def _alarms(axes: Any, found: Rows) -> None:
    for place, (task, colour) in enumerate(TASKS.items()):
        there = [(at, one) for at, one in enumerate(DISTURBANCES) if ("monitor", task, one) in found]
        for share, control in enumerate(("action-conditioned", "observation only")):
            heights = [found["monitor", task, one][control]["auc"] for _, one in there]
            at = [number + 0.26 * place + 0.13 * share for number, _ in there]
            axes.bar(at, heights, 0.13, color=colour, alpha=0.4 if share else 1.0, label=None if share else task)
    axes.axhline(0.5, color="black", linewidth=0.6)
    axes.set_xticks(np.arange(len(DISTURBANCES)) + 0.3, [one.replace(" ", "\n") for one in DISTURBANCES])
    axes.set(ylabel="AUC (0.5: chance)", ylim=(0, 1.05))
    axes.set_title("Which departures are noticed? Pale: without the actions")
    axes.legend(loc="upper right")


def _error(estimates: list[dict[str, float]]) -> list[list[float]]:
    low = [one["value"] - one["low"] for one in estimates]
    return [low, [one["high"] - one["value"] for one in estimates]]


if __name__ == "__main__":
    main()
