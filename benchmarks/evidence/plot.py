"""How does it look? Goals reached by each method, the way to the goal, error by the number of demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cells import BASES, BEST, SHIFTS
from results import CHANGES, REACHED_CM, Figures, last, main_cells, pick, share_reached


def draw(results: Sequence[Figures], path: Path) -> None:
    """Draw reach against error for the main table, the way to the goal, and error by demonstrations."""
    from vjepa2_ac.media.figure import new_figure

    figure = new_figure(9.2, 8.0, layout="constrained")
    places: dict[str, Any] = figure.subplot_mosaic([["bars", "bars"], ["ways", "counts"]])
    _bars(places["bars"], results)
    _ways(places["ways"], results)
    _counts(places["counts"], results)
    figure.savefig(path, dpi=130)


SHOWN = {
    "zero-shot": "#999999",
    BEST: "#1f77b4",
    "full": "#2ca02c",
    "scratch": "#f4a582",
    "scratch, 3x steps": "#d62728",
}


def _bars(axes: Any, results: Sequence[Figures]) -> None:
    groups, shown = [(shift, base) for shift in SHIFTS for base in BASES], {}
    for place, (name, colour) in enumerate(SHOWN.items()):
        for group, (shift, base) in enumerate(groups):
            found = main_cells(results, base, name, shift)
            if found:
                share, at = share_reached(found), group + 0.16 * (place - 2)
                error = [[share.value - share.low], [share.high - share.value]]
                shown[name] = axes.bar(at, share.value, 0.15, yerr=error, capsize=2, color=colour)
    axes.set_xticks(range(len(groups)), [f"{CHANGES[shift]}\nbase of {base}" for shift, base in groups], fontsize=8)
    axes.set_ylim(0, 1.05)
    axes.set_ylabel("goals reached: within 5 cm at the end")
    axes.set_title("Reach after a change of the world, 20 demonstrations", fontsize=11)
    axes.legend(shown.values(), shown, fontsize=8, ncols=len(SHOWN), loc="upper center", bbox_to_anchor=(0.5, -0.14))


def _ways(axes: Any, results: Sequence[Figures]) -> None:
    lines: list[tuple[str, str, str, Callable[[Figures], Any]]] = [
        ("zero action", "zero-shot", "#bbbbbb", lambda one: one["baselines"]["zero action"]),
        ("random", "zero-shot", "#dddd88", lambda one: one["baselines"]["random"]),
        ("oracle", "zero-shot", "#000000", lambda one: one["baselines"]["oracle"]),
        ("zero-shot", "zero-shot", SHOWN["zero-shot"], lambda one: one["reach"]["l1"]),
        (BEST, BEST, SHOWN[BEST], lambda one: one["reach"]["l1"]),
        ("full", "full", SHOWN["full"], lambda one: one["reach"]["l1"]),
    ]
    for label, method, colour, part in lines:
        found = main_cells(results, "many cameras", method)
        if found:
            way = np.concatenate([part(one)["distance_cm"] for one in found]).mean(axis=0)
            axes.plot(range(len(way)), way, color=colour, label=label, marker=".")
    axes.axhline(REACHED_CM, color="#888888", linestyle=":", linewidth=1)
    axes.set_xlabel("model steps of 0.27 s")
    axes.set_ylabel("mean distance to the goal, cm")
    axes.set_title("On the way there (base of many cameras)")
    _legend_below(axes)


def _counts(axes: Any, results: Sequence[Figures]) -> None:
    for base, style in (*((base, "-" if base == "many cameras" else "--") for base in BASES), ("none", "-")):
        for method in ("scratch",) if base == "none" else (BEST, "full"):
            found = {
                episodes: pick(results, shift="look", base=base, method=method, episodes=episodes)
                for episodes in (10, 20, 40)
            }
            points = {count: np.mean([last(one) for one in cells]) for count, cells in found.items() if cells}
            label = method if base == "none" else f"{method}, {base}"
            if points:
                axes.plot(
                    list(points),
                    list(points.values()),
                    style,
                    marker="o",
                    color=SHOWN[method],
                    label=label,
                )
    axes.set_xscale("log", base=2)
    axes.set_xticks([10, 20, 40], ["10", "20", "40"])
    axes.set_xlabel("demonstrations")
    axes.set_ylabel("error 0.8 s ahead / persistence")
    axes.set_title("By the number of demonstrations")
    _legend_below(axes)


def _legend_below(axes: Any) -> None:
    if axes.get_lines():
        axes.legend(fontsize=8, ncols=2, handlelength=3.5, loc="upper center", bbox_to_anchor=(0.5, -0.16))
