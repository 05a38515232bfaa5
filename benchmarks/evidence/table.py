"""What came out? One table and one plot over all cells that are done, in Markdown and PNG."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cells import BASES, BEST, METHODS

from vjepa2_ac.evaluation.bootstrap import mean_of
from vjepa2_ac.evaluation.proportion import share_of

TABLE, PLOT = "evidence.md", "evidence.png"
_BEGIN, _END = "<!-- made by `make evidence`: begin -->", "<!-- made by `make evidence`: end -->"
_REACHED_CM = 5.0
Figures = dict[str, Any]


def read_results(folder: Path) -> list[Figures]:
    """Return the figures of every cell that is done."""
    return [json.loads(path.read_text()) for path in sorted((folder / "results").glob("*.json"))]


def write_tables(folder: Path, out: Path, readme: Path | None = None) -> None:
    """Write evidence.md and evidence.png of what is there, print the table, and put the short one into a README.

    Raises:
        ValueError: The README has no place for it.
    """
    results = read_results(folder)
    if not results:
        print(f"nothing to show: no cell is done in {folder / 'results'}")
        return
    out.mkdir(parents=True, exist_ok=True)
    text = "\n\n".join(
        part for part in (_main(results), _motion(results), _by_episodes(results), _lora(results)) if part
    )
    (out / TABLE).write_text(text + "\n")
    (out / "evidence.json").write_text(json.dumps([_slim(one) for one in results], indent=None) + "\n")
    print(text)
    plot(results, out / PLOT)
    if readme is not None:
        write_summary(results, readme)
    print(f"\n{out / TABLE}\n{out / PLOT}")


def write_summary(results: Sequence[Figures], readme: Path) -> None:
    """Put the short table between the marks in a README, which stays as it is otherwise.

    Raises:
        ValueError: The marks are not there.
    """
    before, begin, end, after = place_in(readme)
    readme.write_text(f"{before}{begin}\n{summary(results)}\n{end}{after}")


def place_in(readme: Path) -> tuple[str, str, str, str]:
    """Return what stands before the short table in a README, the marks around it, and what stands after it.

    Raises:
        ValueError: The marks are not there.
    """
    before, begin, rest = readme.read_text().partition(_BEGIN)
    _, end, after = rest.partition(_END)
    if not (begin and end):
        raise ValueError(f"{readme} has no {_BEGIN} ... {_END}")
    return before, begin, end, after


def summary(results: Sequence[Figures]) -> str:
    """Return the short table: what each method reaches and predicts after the change of camera and look."""
    head = "| | " + " | ".join(f"base of {base}: reached | distance, cm | error 0.8 s ahead" for base in BASES) + " |"
    rows = [head, "|---|" + "---|---|---|" * len(BASES)]
    for name in ("do nothing", "random", "oracle"):
        parts = []
        for base in BASES:
            of_it = _of_policy(results, base, name)
            parts += [_reach(of_it, "l1"), _distance(of_it, "l1"), ""] if of_it else ["", "", ""]
        rows.append(f"| {name} | {' | '.join(parts)} |")
    for method in METHODS.values():
        parts = []
        for base in BASES:
            found = _main_cells(results, "none" if method.kind == "scratch" else base, method.name)
            errors = [_last(one) for one in found]
            parts += [_reach(found, "l1"), _distance(found, "l1"), f"{np.mean(errors):.3f}"] if found else ["", "", ""]
        rows.append(f"| {method.name} | {' | '.join(parts)} |")
    return "\n".join(rows)


def pick(results: Sequence[Figures], **wanted: Any) -> list[Figures]:
    """Return the cells of which these are true, by seed."""
    found = [one for one in results if all(one["cell"][key] == value for key, value in wanted.items())]
    return sorted(found, key=lambda one: one["cell"]["seed"])


def _main(results: Sequence[Figures]) -> str:
    parts = ["### Another camera, light, colours and table (20 demonstrations)"]
    for base in BASES:
        rows = _policies(results, base)
        for method in METHODS.values():
            name = "none" if method.kind == "scratch" else base
            found = _main_cells(results, name, method.name)
            if found:
                rows.append(_row(method.name, found))
        if len(rows) > 3:
            parts.append(f"Base of **{base}**\n\n" + _table(rows))
    return "\n\n".join(parts) if len(parts) > 1 else ""


def _motion(results: Sequence[Figures]) -> str:
    rows = _policies(results, BASES[0], "motion")
    for base in BASES:
        for method in METHODS.values():
            if method.kind != "scratch":
                found = pick(results, shift="motion", base=base, method=method.name)
                rows += [_row(f"{method.name} ({base})", found)] if found else []
    found = pick(results, shift="motion", base="none")
    rows += [_row("scratch", found)] if found else []
    return "### The robot mounted turned by 60 degrees (20 demonstrations)\n\n" + _table(rows) if rows else ""


def _by_episodes(results: Sequence[Figures]) -> str:
    rows = []
    for base, method in [(base, method) for base in BASES for method in (BEST, "full")] + [("none", "scratch")]:
        for episodes in (10, 20, 40):
            found = pick(results, shift="look", base=base, method=method, episodes=episodes)
            if found:
                rows.append(_row(f"{method} ({base}), {episodes} demonstrations", found))
    few = any(one["cell"]["episodes"] in (10, 40) for one in results)
    return "### By the number of demonstrations\n\n" + _table(rows) if few else ""


def _lora(results: Sequence[Figures]) -> str:
    """Return what share of full fine-tuning's gain each LoRA has, seed by seed, and how its reaching compares."""
    lines = []
    for base in BASES:
        for method in METHODS.values():
            if method.kind != "LoRA":
                continue
            shares, ours, theirs = [], 0, 0
            for one in pick(results, shift="look", base=base, method=method.name, episodes=20):
                seed = one["cell"]["seed"]
                full = pick(results, shift="look", base=base, method="full", episodes=20, seed=seed)
                start = pick(results, shift="look", base=base, method="zero-shot", seed=seed)
                if full and start:
                    before = _last(start[0])
                    shares.append((before - _last(one)) / (before - _last(full[0])))
                    ours += sum(_reached(one))
                    theirs += sum(_reached(full[0]))
            if shares:
                spread = f"{min(shares):.1%} to {max(shares):.1%} over {len(shares)} seeds"
                lines.append(
                    f"- {base}, {method.name}: {np.mean(shares):.1%} of full fine-tuning's gain in error 0.8 s ahead"
                    f" ({spread}); reached {ours}, full fine-tuning {theirs}"
                )
    return "### LoRA against full fine-tuning\n\n" + "\n".join(lines) if lines else ""


_HEAD = (
    "method | error 0.27 / 0.53 / 0.80 s | zero / shuffled actions | reach at the end | distance, cm | L2 energy"
    " | trained | MB | CPU min | error on A, on"
)


def _table(rows: list[str]) -> str:
    columns = _HEAD.count("|") + 1
    return "\n".join([f"| {_HEAD} |", "|" + "---|" * columns, *rows])


def _row(name: str, found: Sequence[Figures]) -> str:
    shifted = [one["shifted"] for one in found]
    rollout = np.mean([one["rollout_over_persistence"] for one in shifted], axis=0)
    last = [one["rollout_over_persistence"][-1] for one in shifted]
    wrong = [np.mean([one[key] for one in shifted]) for key in ("one_step_zero_actions", "one_step_shuffled_actions")]
    trained = found[0]["trained_share"]
    cells = [
        name,
        f"{' / '.join(f'{value:.3f}' for value in rollout)} ({min(last):.3f} to {max(last):.3f})",
        f"{wrong[0]:.3f} / {wrong[1]:.3f}",
        _reach(found, "l1"),
        _distance(found, "l1"),
        _reach(found, "l2"),
        f"{trained:.1%}" if trained else "",
        f"{found[0]['adapter_mb']:.2f}" if trained else "",
        f"{np.mean([one['cpu_minutes'] for one in found]):.1f}" if trained else "",
        _forgotten(found),
    ]
    return "| " + " | ".join(cells) + " |"


def _policies(results: Sequence[Figures], base: str, shift: str = "look") -> list[str]:
    rows = []
    for name in ("do nothing", "random", "oracle"):
        of_it = _of_policy(results, base, name, shift)
        if of_it:
            rows.append(f"| {name} | | | {_reach(of_it, 'l1')} | {_distance(of_it, 'l1')} | | | | | |")
    return rows


def _of_policy(results: Sequence[Figures], base: str, name: str, shift: str = "look") -> list[Figures]:
    """Return how far those got who need no model, on the goals of a base's cells."""
    found = pick(results, shift=shift, base=base, method="zero-shot")
    return [{"reach": {"l1": one["baselines"][name]}} for one in found if "baselines" in one]


def _reach(found: Sequence[Figures], distance: str) -> str:
    reached = [flag for one in found if distance in one["reach"] for flag in _reached(one, distance)]
    if not reached:
        return ""
    share = share_of(sum(reached), len(reached))
    return f"{share.value:.0%} ({share.low:.0%} to {share.high:.0%}) of {len(reached)}"


def _distance(found: Sequence[Figures], distance: str) -> str:
    ends = np.array([row[-1] for one in found for row in one["reach"][distance]["distance_cm"]])
    mean = mean_of(ends, [str(place) for place in range(len(ends))])
    return f"{mean.value:.1f} ({mean.low:.1f} to {mean.high:.1f})" if mean.has_interval else f"{mean.value:.1f}"


def _forgotten(found: Sequence[Figures]) -> str:
    on = [one["forgetting"]["on"]["rollout_over_persistence"][-1] for one in found if "forgetting" in one]
    if not on:
        return ""
    checked = [one["forgetting"].get("off_is_base_bit_for_bit") for one in found]
    word = (
        "; off: the base's, bit for bit"
        if all(checked)
        else "; **off differs from the base**"
        if False in checked
        else ""
    )
    return f"{np.mean(on):.3f}{word}"


def _reached(one: Figures, distance: str = "l1") -> list[bool]:
    return [row[-1] < _REACHED_CM for row in one["reach"][distance]["distance_cm"]]


def _last(one: Figures) -> float:
    return float(one["shifted"]["rollout_over_persistence"][-1])


def _main_cells(results: Sequence[Figures], base: str, method: str) -> list[Figures]:
    """Return a row of the main table: zero-shot needs no demonstrations, the others have 20."""
    episodes = 0 if METHODS[method].kind == "zero-shot" else 20
    return pick(results, shift="look", base=base, method=method, episodes=episodes)


def _slim(one: Figures) -> Figures:
    """Return figures without the ways between start and end: what the table is made of."""
    ends = {
        key: {**value, "distance_cm": [row[-1] for row in value["distance_cm"]]} for key, value in one["reach"].items()
    }
    return {key: value for key, value in one.items() if key != "baselines"} | {"reach": ends}


def plot(results: Sequence[Figures], path: Path) -> None:
    """Draw reach against error for the main table, the way to the goal, and error by demonstrations."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    bars, ways, counts = figure.subplots(1, 3, width_ratios=(1.5, 1.0, 0.9))
    _bars(bars, results)
    _ways(ways, results)
    _counts(counts, results)
    figure.savefig(path, dpi=110)


_COLOURS = {"zero-shot": "#999999", "LoRA": "#1f77b4", "full": "#2ca02c", "scratch": "#d62728"}


def _bars(axes: Any, results: Sequence[Figures]) -> None:
    names = list(METHODS)
    for side, base in enumerate(BASES):
        for place, name in enumerate(names):
            method = METHODS[name]
            of = "none" if method.kind == "scratch" else base
            found = _main_cells(results, of, name)
            if not found or (of == "none" and side):
                continue
            reached = [flag for one in found for flag in _reached(one)]
            share = share_of(sum(reached), len(reached))
            at = place + (0.0 if of == "none" else 0.4 * side - 0.2)
            error = [[share.value - share.low], [share.high - share.value]]
            look = {"color": _COLOURS[method.kind], "alpha": 1.0 if side or of == "none" else 0.55}
            axes.bar(at, share.value, 0.8 if of == "none" else 0.38, yerr=error, capsize=2, **look)
    axes.set_xticks(range(len(names)), names, rotation=40, ha="right")
    axes.set_ylim(0, 1.05)
    axes.set_ylabel("goals reached: within 5 cm at the end")
    axes.set_title(
        "Reach after a change of camera and look, 20 demonstrations\n(pale: base of one camera, full: of many)"
    )


def _ways(axes: Any, results: Sequence[Figures]) -> None:
    lines: list[tuple[str, str, str, Callable[[Figures], Any]]] = [
        ("do nothing", "zero-shot", "#bbbbbb", lambda one: one["baselines"]["do nothing"]),
        ("random", "zero-shot", "#dddd88", lambda one: one["baselines"]["random"]),
        ("oracle", "zero-shot", "#000000", lambda one: one["baselines"]["oracle"]),
        ("zero-shot", "zero-shot", _COLOURS["zero-shot"], lambda one: one["reach"]["l1"]),
        (BEST, BEST, _COLOURS["LoRA"], lambda one: one["reach"]["l1"]),
        ("full", "full", _COLOURS["full"], lambda one: one["reach"]["l1"]),
    ]
    for label, method, colour, part in lines:
        found = _main_cells(results, "many cameras", method)
        if found:
            way = np.concatenate([part(one)["distance_cm"] for one in found]).mean(axis=0)
            axes.plot(range(len(way)), way, color=colour, label=label, marker=".")
    axes.axhline(_REACHED_CM, color="#888888", linestyle=":", linewidth=1)
    axes.set_xlabel("model steps of 0.27 s")
    axes.set_ylabel("mean distance to the goal, cm")
    axes.set_title("On the way there (base of many cameras)")
    if axes.get_lines():
        axes.legend(fontsize=8)


def _counts(axes: Any, results: Sequence[Figures]) -> None:
    for base, style in (*((base, "-" if base == "many cameras" else "--") for base in BASES), ("none", "-")):
        for method in ("scratch",) if base == "none" else (BEST, "full"):
            found = {
                episodes: pick(results, shift="look", base=base, method=method, episodes=episodes)
                for episodes in (10, 20, 40)
            }
            points = {count: np.mean([_last(one) for one in cells]) for count, cells in found.items() if cells}
            label = method if base == "none" else f"{method}, {base}"
            if points:
                axes.plot(
                    list(points),
                    list(points.values()),
                    style,
                    marker="o",
                    color=_COLOURS[METHODS[method].kind],
                    label=label,
                )
    axes.set_xscale("log", base=2)
    axes.set_xticks([10, 20, 40], ["10", "20", "40"])
    axes.set_xlabel("demonstrations")
    axes.set_ylabel("error 0.8 s ahead / persistence")
    axes.set_title("By the number of demonstrations")
    if axes.get_lines():
        axes.legend(fontsize=8)
