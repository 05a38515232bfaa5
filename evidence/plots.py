"""Plot the goals that each method reaches after each change."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from methods import BASES, BEST, SHIFTS
from results import CHANGES, Figures, main_cells, share_reached

SHOWN = {
    "zero-shot": "#999999",
    BEST: "#1f77b4",
    "full": "#2ca02c",
    "scratch": "#f4a582",
    "scratch, 3x steps": "#d62728",
}


def draw(results: Sequence[Figures], path: Path) -> None:
    """Plot the share of goals reached, a group of bars for each change and base."""
    from vjepa2_ac.media.figure import new_figure

    figure = new_figure(9.2, 4.6, layout="constrained")
    axes = figure.subplots()
    groups, shown = [(shift, base) for shift in SHIFTS for base in BASES], {}
    for place, (name, colour) in enumerate(SHOWN.items()):
        for group, (shift, base) in enumerate(groups):
            if cells := main_cells(results, base, name, shift):
                share, at = share_reached(cells), group + 0.16 * (place - 2)
                error = [[share.value - share.low], [share.high - share.value]]
                shown[name] = axes.bar(at, share.value, 0.15, yerr=error, capsize=2, color=colour)
    axes.set_xticks(range(len(groups)), [f"{CHANGES[shift]}\nbase of {base}" for shift, base in groups], fontsize=8)
    axes.set_ylim(0, 1.05)
    axes.set_ylabel("goals reached: within 5 cm at the end")
    axes.set_title("Reach after a change of the scene, 20 demonstrations", fontsize=11)
    axes.legend(shown.values(), shown, fontsize=8, ncols=len(SHOWN), loc="upper center", bbox_to_anchor=(0.5, -0.14))
    figure.savefig(path, dpi=130)
